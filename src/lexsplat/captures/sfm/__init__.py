"""Structure from motion: from photos without cameras to a COLMAP model."""
