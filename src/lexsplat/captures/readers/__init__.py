"""Readers of camera files (COLMAP, ``transforms.json``) and of video frames."""
