"""Rendering of Gaussians to images with any number of channels, and its transpose.

`render` composites color, features and alpha of one view. Gradients of color and alpha reach the geometry; gradients
of features reach the features only. `prepare` computes once what depends on geometry and camera alone.
`back_project` goes the other way, from pixels to Gaussians. The device of the Gaussians decides
the rasterizer: our kernels on a CPU, gsplat on CUDA.
"""

from lexsplat.rendering.back_projection import (
    BACK_PROJECTED_CHANNELS,
    accumulate_weights,
    back_project,
    measure_weights,
    weigh_cells,
)
from lexsplat.rendering.compositing import prepare, render
from lexsplat.rendering.results import PreparedView, Projection, Rendering

__all__ = [
    "BACK_PROJECTED_CHANNELS",
    "PreparedView",
    "Projection",
    "Rendering",
    "accumulate_weights",
    "back_project",
    "measure_weights",
    "prepare",
    "render",
    "weigh_cells",
]
