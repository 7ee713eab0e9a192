"""Put per-pixel labels of your own onto Gaussians, without training.

Whatever tool labeled your images, if the labels are small integers per pixel, one pass over the views tells
for every Gaussian how much of each label it carries.

    python examples/04_labels_into_gaussians.py
"""

import numpy as np
import torch

from lexsplat.geometry.cameras import look_at
from lexsplat.geometry.gaussians import gaussians_from_points
from lexsplat.rendering import accumulate_codes, render

# Two clouds of points: label 0 on the left, label 1 on the right.
rng = np.random.default_rng(0)
points = rng.normal(scale=0.12, size=(600, 3))
labels = np.arange(600) % 2
points[:, 0] += np.where(labels == 0, -0.8, 0.8)
gaussians = gaussians_from_points(points, np.ones((600, 3)), sh_degree=0, opacity=0.7)

# The "label images": here simply left and right halves of what the cameras see.
histogram = torch.zeros(600, 2)
for angle in np.linspace(-0.5, 0.5, 5):
    position = [3 * np.sin(angle), -3 * np.cos(angle), 0.6]
    camera = look_at(position, [0.0, 0.0, 0.0], [0.0, 0.0, 1.0], width=160, height=120, fov_y=0.8)
    label_map = torch.zeros(120, 160, dtype=torch.uint8)
    label_map[:, 80:] = 1
    histogram += accumulate_codes(gaussians, camera, label_map, num_codes=2)

found = histogram.argmax(dim=1).numpy()
seen = histogram.sum(dim=1).numpy() > 0.01  # what is hidden in every view gets no label
print(f"{(found == labels)[seen].mean():.1%} of the {seen.sum()} Gaussians in sight carry the right label")

# A label image of any view is then a rendering like any other.
shares = histogram / histogram.sum(dim=1, keepdim=True).clamp_min(1e-8)
image = render(gaussians, camera, features=shares, color=False).features  # [H, W, 2]
print(f"left third shows label {int(image[:, :50].sum((0, 1)).argmax())}")
