"""From a capture to a scene: settings, inputs, stages, provenance."""
