"""lexsplat: search a place with words."""

__version__ = "0.1.0"
