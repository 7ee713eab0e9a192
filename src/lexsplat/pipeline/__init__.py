"""From a capture to a scene: settings, stages, provenance."""
