"""Readers of camera files and videos: COLMAP, ``transforms.json``, video."""
