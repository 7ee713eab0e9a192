"""How work runs and is kept: errors, progress, files, memory, devices, the training loop, the environment."""
