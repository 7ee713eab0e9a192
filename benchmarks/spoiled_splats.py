"""Splats as they are found: compressed, without spherical harmonics, and with floaters; for `without_photos.py`.

    python benchmarks/spoiled_splats.py photos/gaussians.ply FOLDER
    lexsplat language --splats FOLDER/floaters.ply --output chosen --clip bundled --codebook.num-codes 256
    cp -r photos again  # the features of its photos are kept
    lexsplat language --splats FOLDER/floaters.ply second --output again --clip bundled
    python benchmarks/without_photos.py again chosen

Floaters are a tenth as many as there are Gaussians: at random places of a box of twice the size of the scene without
its background, of the sizes of random Gaussians doubled, of random colors, and of opacities from 0.2 to 0.95.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from lexsplat.geometry.gaussians import TENSORS, Gaussians
from lexsplat.scenes.formats.ply import write_ply
from lexsplat.scenes.formats.reading import read_splats
from lexsplat.scenes.formats.sog_writing import write_sog
from lexsplat.scenes.formats.spz import write_spz


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("splats", type=Path)
    parser.add_argument("folder", type=Path)
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    gaussians = read_splats(options.splats)
    write_sog(gaussians, options.folder / "sog.sog")
    write_spz(gaussians, options.folder / "spz.spz")
    bare = replace(gaussians, shN=torch.zeros(len(gaussians), 0, 3))
    write_ply(bare, options.folder / "no_harmonics.ply")
    write_ply(with_floaters(gaussians), options.folder / "floaters.ply")


def with_floaters(gaussians: Gaussians, seed: int = 0) -> Gaussians:
    """The Gaussians, followed by a tenth as many floaters."""
    rng = np.random.default_rng(seed)
    count = len(gaussians) // 10
    low, high = np.quantile(gaussians.means.numpy(), [0.05, 0.95], axis=0)
    places = (low + high) / 2 + rng.uniform(-1, 1, (count, 3)) * (high - low)
    models = gaussians.select(torch.from_numpy(rng.choice(len(gaussians), count)))
    opacities = torch.from_numpy(rng.uniform(0.2, 0.95, count).astype(np.float32))
    floaters = replace(
        models,
        means=torch.from_numpy(places.astype(np.float32)),
        log_scales=models.log_scales + np.log(2),
        opacity_logits=opacities.logit(),
        sh0=torch.from_numpy(rng.normal(0, 1, (count, 1, 3)).astype(np.float32)),
    )
    joined = {name: torch.cat([getattr(gaussians, name), getattr(floaters, name)]) for name in TENSORS}
    return replace(gaussians, **joined)


if __name__ == "__main__":
    main()
