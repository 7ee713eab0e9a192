"""The language feature map F of a view, and its image: the three directions in which features vary most as colors.

F = p S blends the codewords S by the rendered distribution over codes p (supplement B; the colors as in Fig. 1). The
image is the principal component analysis of the codewords, weighted by how many Gaussians carry them, so that a thing
has the same color in every view.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from PIL import Image
from torch import Tensor

from lexsplat.captures import stem_of
from lexsplat.geometry.cameras import Camera
from lexsplat.language.fields import LanguageField
from lexsplat.rendering.first_drawing import compile_drawing
from lexsplat.runtime.files import atomic_path, write_tensors
from lexsplat.runtime.progress import Event

if TYPE_CHECKING:
    from lexsplat.scenes.scene import Scene
    from lexsplat.scenes.views import StoredView

_SPREAD = 2.0
"""Standard deviations from the mean that the darkest and the brightest color stand for."""
_GAUSSIANS = 1 << 16


@torch.no_grad()
def feature_map(scene: Scene, view: str | StoredView | Camera) -> Tensor:
    """F of a view ``[H, W, D]``, unit length; 0 where nothing is rendered.

    Raises:
        QueryError: If the view is unknown.
    """
    codewords = scene.field.codebook.clip.to(scene.gaussians.device).float()
    blended = scene.field.render_scores(scene.gaussians, scene.camera(view), codewords)
    return torch.nn.functional.normalize(blended, dim=-1)


@torch.no_grad()
def feature_picture(scene: Scene, view: str | StoredView | Camera, colors: Tensor | None = None) -> Tensor:
    """The principal components of F as colors ``[H, W, 3]`` in 0..1; black where nothing is rendered.

    Args:
        scene: The scene.
        view: Name of a view, or a camera.
        colors: `code_colors` of its field, for several views; None computes them.

    Raises:
        QueryError: If the view is unknown.
    """
    colors = code_colors(scene.field) if colors is None else colors
    table = colors.to(scene.gaussians.device)
    return scene.field.render_scores(scene.gaussians, scene.camera(view), table).clamp(0, 1)


@torch.no_grad()
def code_colors(field: LanguageField) -> Tensor:
    """A color for each code ``[K, 3]`` in 0..1: the first three principal components of the codewords."""
    codewords = field.codebook.clip.double().cpu()
    index = torch.arange(len(field.uncertainties), device=field.uncertainties.device)
    masses = torch.zeros(len(codewords), dtype=torch.float64)
    for block in index.split(_GAUSSIANS):
        masses += field.select(block).code_probabilities().sum(0).double().cpu()
    shares = masses / masses.sum().clamp_min(1e-12)
    centered = codewords - shares @ codewords
    _, values, directions = torch.linalg.svd(shares.sqrt()[:, None] * centered, full_matrices=False)
    kept = min(3, len(values))
    directions = directions[:kept]
    directions = directions * directions.sum(1, keepdim=True).sign()  # the sign of a direction means nothing
    spread = (_SPREAD * values[:kept]).clamp_min(1e-9)
    colors = torch.full((len(codewords), 3), 0.5)
    colors[:, :kept] += (0.5 * (centered @ directions.T) / spread).float()
    return colors.clamp(0, 1)


def write_features(scene: Scene, views: Sequence[str], folder: Path) -> dict[str, dict[str, str]]:
    """Write ``features/VIEW.safetensors`` (``features`` ``[H, W, D]`` float16) and ``features/VIEW.png`` of views.

    Returns:
        Paths by name of the view: ``{"map", "picture"}``.

    Raises:
        QueryError: If a view is unknown.
    """
    written, colors = {}, code_colors(scene.field)
    compile_drawing(scene.gaussians.device, scene.listener)
    for done, name in enumerate(views):
        scene.listener(Event("features", done, len(views)))
        stored, picture = (
            folder / "features" / f"{stem_of(name)}{ending}" for ending in (".safetensors", ".png")
        )
        write_tensors(
            stored, {"features": feature_map(scene, name).half().cpu().contiguous()}, {"view": name}
        )
        pixels = (feature_picture(scene, name, colors) * 255).round().to(torch.uint8).cpu().numpy()
        with atomic_path(picture) as temporary:
            Image.fromarray(pixels).save(temporary, format="PNG")
        written[name] = {"map": str(stored), "picture": str(picture)}
    scene.listener(Event("features", len(views), len(views)))
    return written
