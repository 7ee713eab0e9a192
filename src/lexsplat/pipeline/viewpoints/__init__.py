"""Cameras for splats that come without a capture: chosen from the Gaussians alone."""

from lexsplat.pipeline.viewpoints.choosing import ChosenViews, choose_views
from lexsplat.pipeline.viewpoints.stage import capture_of_splats, splats_of_capture

__all__ = ["ChosenViews", "capture_of_splats", "choose_views", "splats_of_capture"]
