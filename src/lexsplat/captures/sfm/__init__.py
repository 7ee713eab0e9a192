"""Structure from motion: photos without cameras in, a COLMAP model out."""
