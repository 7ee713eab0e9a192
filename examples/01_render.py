"""Render Gaussians with a camera, and send gradients through the image.

python examples/01_render.py [OUTPUT.png]
"""

import sys
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from lexsplat.geometry.cameras import look_at
from lexsplat.geometry.gaussians import gaussians_from_points
from lexsplat.rendering import render

output = Path(sys.argv[1] if len(sys.argv) > 1 else "output/examples/ball.png")

# 2,000 points on a ball, colored by their position.
rng = np.random.default_rng(0)
directions = rng.normal(size=(2000, 3))
points = directions / np.linalg.norm(directions, axis=1, keepdims=True)
gaussians = gaussians_from_points(points, 0.5 + 0.5 * points, sh_degree=0, opacity=0.8)

camera = look_at([0.0, -3.0, 1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0], width=320, height=240, fov_y=0.8)

# Rendering is differentiable. This gradient states how each color must change to make the image greener.
gaussians.sh0.requires_grad_()
rendering = render(gaussians, camera)
rendering.image[..., 1].mean().backward()
print(f"the Gaussians cover {float(rendering.alpha.detach().mean()):.0%} of the image")
print(f"{int((gaussians.sh0.grad[:, 0, 1] > 0).sum())} of {len(gaussians)} Gaussians are visible")

output.parent.mkdir(parents=True, exist_ok=True)
pixels = (rendering.image.detach().clamp(0, 1) * 255).to(torch.uint8).numpy()
Image.fromarray(pixels).save(output)
print(f"image: {output}")
