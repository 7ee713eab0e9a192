"""Encoders of colors that count what they encode."""

from __future__ import annotations

import threading

import torch
import torch.nn.functional as F


class ColorEncoder:
    """Embeds the mean color; counts its calls."""

    name, image_size, dim, patches = "color", 8, 4, 2
    device = torch.device("cpu")

    def __init__(self, content_hash="color", fail_after=None):
        self.content_hash = content_hash
        self.crops, self.texts, self.fail_after = 0, 0, fail_after
        self._lock = threading.Lock()

    def encode_images(self, images):
        with self._lock:
            self.crops += len(images)
            if self.fail_after is not None and self.crops > self.fail_after:
                raise RuntimeError("stopped in the middle")
        mean = images.mean((-2, -1))
        return F.normalize(torch.cat([mean, torch.ones(len(mean), 1)], 1), dim=-1)

    def encode_patches(self, images):
        """Quarters of the crops, by their mean colors."""
        quarters = F.adaptive_avg_pool2d(images, 2).permute(0, 2, 3, 1)
        ones = torch.ones(*quarters.shape[:3], 1)
        return self.encode_images(images), F.normalize(torch.cat([quarters, ones], -1), dim=-1)

    def encode_text(self, prompts):
        self.texts += len(prompts)
        codes = torch.tensor([[float(ord(c)) for c in prompt.ljust(4)[:4]] for prompt in prompts])
        return F.normalize(codes, dim=-1)


class GridEncoder:
    """Dense features: the image itself, a cell for each block of ``stride`` pixels."""

    name, content_hash, dim = "grid", "grid", 4
    device = torch.device("cpu")

    def __init__(self):
        self.images = 0

    def encode_dense(self, image, *, short_side=224, stride=None, facet="key", layer=None, max_tokens=4096):
        self.images += 1
        blocks = F.avg_pool2d(image, stride).permute(1, 2, 0)
        return F.normalize(torch.cat([blocks, torch.ones(*blocks.shape[:2], 1)], -1), dim=-1)
