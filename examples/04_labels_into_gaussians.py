"""Put labels of pixels onto Gaussians, without training.

    python examples/04_labels_into_gaussians.py

The labels may come from any tool, if they are small integers for each pixel. Back-projecting them one-hot sums, for
each Gaussian, the weight with which it contributes to pixels of each label.
"""

import numpy as np
import torch

from lexsplat.geometry.cameras import look_at
from lexsplat.geometry.gaussians import gaussians_from_points
from lexsplat.rendering import back_project, render

# Two clouds of points: label 0 on the left, label 1 on the right.
rng = np.random.default_rng(0)
points = rng.normal(scale=0.12, size=(600, 3))
labels = np.arange(600) % 2
points[:, 0] += np.where(labels == 0, -0.8, 0.8)
gaussians = gaussians_from_points(points, np.ones((600, 3)), sh_degree=0, opacity=0.7)

# Label images of five views. Here they are the left and the right half of each image.
histogram = torch.zeros(600, 2)
for angle in np.linspace(-0.5, 0.5, 5):
    position = [3 * np.sin(angle), -3 * np.cos(angle), 0.6]
    camera = look_at(position, [0.0, 0.0, 0.0], [0.0, 0.0, 1.0], width=160, height=120, fov_y=0.8)
    label_map = torch.zeros(120, 160, dtype=torch.int64)
    label_map[:, 80:] = 1
    histogram += back_project(gaussians, camera, torch.nn.functional.one_hot(label_map, 2).float())

found = histogram.argmax(dim=1).numpy()
seen = histogram.sum(dim=1).numpy() > 0.01  # a Gaussian that is hidden in all views receives no label
print(f"{(found == labels)[seen].mean():.1%} of the {seen.sum()} visible Gaussians carry the right label")

# The shares of labels are rendered like any other feature.
shares = histogram / histogram.sum(dim=1, keepdim=True).clamp_min(1e-8)
image = render(gaussians, camera, features=shares, color=False).features  # [H, W, 2]
print(f"the left third of the last view shows label {int(image[:, :50].sum((0, 1)).argmax())}")
