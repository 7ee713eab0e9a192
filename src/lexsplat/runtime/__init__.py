"""Infrastructure without domain knowledge: errors, progress, files, memory, devices, the training loop."""
