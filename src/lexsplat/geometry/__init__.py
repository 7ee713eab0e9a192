"""Value types: cameras, Gaussians, boxes, and the world with its up and scale."""
