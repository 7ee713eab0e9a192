"""The scenes and encoders that ship with lexsplat, and the demo that runs the whole system on them."""
