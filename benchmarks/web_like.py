"""Encoders with the statistics of a CLIP trained on the web, made from the bundled one.

    python benchmarks/web_like.py --output output/web_like --seeds 0 1 2

The last layers of the bundled CLIP are replaced (`make_web_like`): what images and texts share is scaled down, each
tower gets a common direction and directions that the other tower lacks, and each word an offset. The result is an
ordinary folder of transformers for ``--clip FOLDER``. It knows what the bundled encoder knows, in a narrow cone: what
a scene loses with it is lost to numbers that suit one encoder only. Prints the cosines that are reached.
"""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from records import argument_parser
from scipy.ndimage import distance_transform_edt
from torch import Tensor, nn

from lexsplat.evaluation.demo import demo_capture
from lexsplat.features.clip import ClipEncoder
from lexsplat.features.encoders import load_clip
from lexsplat.features.hub import model_folder
from lexsplat.queries.relevancy import CANONICAL_PHRASES

NOUNS = (
    "chair", "bed", "window", "door", "computer", "telephone", "clock", "shoe", "hat", "umbrella", "bicycle",
    "airplane", "horse", "dog", "cat", "fish", "elephant", "pizza", "cake", "carrot", "knife", "guitar",
    "piano", "hammer", "scissors", "key", "bridge", "castle", "river", "cloud", "person", "television", "tree",
    "bread", "spoon", "basket", "drum", "camera", "pillow", "curtain", "mirror", "glove", "backpack",
    "suitcase", "train", "ship",
)  # fmt: skip
"""Things that no bundled scene holds."""
KINDS = (
    "apple", "rubber duck", "mug", "stack of books", "vase", "ring", "traffic cone", "potted plant",
    "table lamp", "banana", "teddy bear", "striped ball", "bowl", "candle", "green bottle", "pumpkin",
    "toy car", "wooden crate", "table", "cloth", "wall", "red apple", "blue mug", "gold ring", "fruit",
    "something made of metal", "something to drink from", "mug handle", "bear nose",
)  # fmt: skip
"""Phrases of the kind that the bundled encoder knows."""


@dataclass(frozen=True)
class Facts:
    """Mean cosines of a CLIP trained on the web, which `make_web_like` aims at.

    Args:
        images: Of two crops.
        texts: Of two nouns.
        matched: Of a crop and its phrase.
        unmatched: Of a crop and a noun.
        canonical: Of a crop and the nearest canonical phrase.
        offset: Standard deviation of the offsets of words, as a share of matched minus unmatched.
    """

    images: float = 0.5
    texts: float = 0.75
    matched: float = 0.28
    unmatched: float = 0.18
    canonical: float = 0.21
    offset: float = 0.2


@dataclass(frozen=True)
class Sample:
    """Hidden states before the last layer of the bundled CLIP.

    Args:
        crops: Of random crops ``[C, H]``.
        things: Of crops of things ``[M, H]``.
        phrases: Of the phrase of each ``[M, H']``.
        nouns, kinds, canonical: Of `NOUNS`, of `KINDS` with the phrases, and of the canonical phrases ``[*, H']``.
    """

    crops: Tensor
    things: Tensor
    phrases: Tensor
    nouns: Tensor
    kinds: Tensor
    canonical: Tensor


@torch.no_grad()
def make_web_like(folder: Path, seed: int = 0, facts: Facts = Facts(), private: int = 15) -> Path:
    """Save an encoder with the statistics of a web-trained CLIP as a folder of transformers.

    An image is ``Q (s x + a e + p y)``: x is the bundled embedding, e a constant, y its private directions, and Q a
    random rotation. A text is the same with its own constants, and with an offset along the images' constant, a
    linear function of its hidden state.

    Args:
        folder: Where it is written.
        seed: Of rotation, private directions and offsets.
        facts: What to imitate.
        private: Number of private dimensions of each tower.
    """
    bundled = load_clip("bundled")
    if not isinstance(bundled, ClipEncoder):
        raise TypeError("the bundled encoder is a ClipEncoder")
    model, sample = bundled._model, _sample(bundled)
    draw = torch.Generator().manual_seed(seed)
    image = _Tower(model.vision_model.post_layernorm, model.visual_projection, sample.crops)
    texts = torch.cat([sample.nouns, sample.kinds])
    text = _Tower(model.text_model.final_layer_norm, model.text_projection, texts)

    x, t = image.unit(sample.things), text.unit(sample.phrases)
    signal = float((x * t).sum(1).mean() - (x @ text.unit(sample.kinds).T).mean())
    shares_image = _shares(0.5, facts.images, image.unit(sample.crops))
    shares_text = _shares(
        (facts.matched - facts.unmatched) / signal / 0.5, facts.texts, text.unit(sample.nouns)
    )
    dim, width = x.shape[1], x.shape[1] + 2 + 2 * private
    rotation = torch.linalg.qr(torch.randn(width, width, generator=draw, dtype=torch.float64))[0]
    rows = torch.zeros(width, image.size, dtype=torch.float64)
    rows[:dim] = shares_image[0] * image.shared
    rows[dim] = shares_image[1] * image.constant
    rows[dim + 2 : dim + 2 + private] = shares_image[2] * image.private(private, draw)
    words = _text_rows(text, sample, facts, shares_text, rows, (dim, private), draw)
    model.visual_projection, model.text_projection = _layer(rotation @ rows), _layer(rotation @ words)
    model.config.projection_dim = width
    model.save_pretrained(folder)
    for path in Path(model_folder("bundled", "clip")).glob("*.json"):
        if path.name != "config.json":
            shutil.copy(path, folder)
    return folder


class _Tower:
    """The last layers of a tower as linear functions of its normalized hidden state."""

    def __init__(self, norm: nn.LayerNorm, projection: nn.Linear, hidden: Tensor) -> None:
        self.weight = projection.weight.double()
        self.size = self.weight.shape[1]
        self.shared = self.weight / float((hidden @ self.weight.T).norm(dim=1).mean())
        self.hidden = hidden
        # LN(h) = gamma z + beta with sum z = 0: the row 1 / gamma sees the constant sum(beta / gamma) only.
        row = 1 / norm.weight.double()
        self.constant = row / float((norm.bias.double() * row).sum())
        self.centered = hidden - hidden.mean(0)

    def unit(self, hidden: Tensor) -> Tensor:
        return nn.functional.normalize(hidden @ self.weight.T, dim=1)

    def affine(self, rows: Tensor, offsets: Tensor) -> Tensor:
        """Rows ``[R, H]`` of the functions ``rows (h - mean) + offsets``."""
        return rows + (offsets - rows @ self.hidden.mean(0))[:, None] * self.constant

    def private(self, count: int, draw: torch.Generator) -> Tensor:
        """Random functions of the whitened hidden state; their vector has length 1 in root mean square."""
        values, vectors = torch.linalg.eigh(self.centered.T @ self.centered / len(self.centered))
        whiten = vectors / (values.clamp_min(0) + 1e-3 * float(values[-1])).sqrt()
        rows = torch.randn(count, self.size, generator=draw, dtype=torch.float64) @ whiten.T
        spread = (self.centered @ rows.T).square().mean(0).sqrt()
        return self.affine(rows / spread[:, None] / math.sqrt(count), torch.zeros(count, dtype=torch.float64))


# The image tower, its dimensions and the facts, which the text tower has to agree with.
def _text_rows(
    text: _Tower,
    sample: Sample,
    facts: Facts,
    shares: tuple[float, float, float],
    rows: Tensor,
    dims: tuple[int, int],
    draw: torch.Generator,
) -> Tensor:
    """The text tower's projection that reaches the levels of ``facts`` beside the image tower's ``rows``."""
    dim, private = dims
    own = text.private(private, draw)
    offsets = text.private(1, draw) * facts.offset * (facts.matched - facts.unmatched)
    common = float(rows[dim] @ sample.crops.mean(0))
    # The part of texts along the images' constant sets every level; normalization couples the levels, so they are
    # corrected until they hold.
    level = {"matched": facts.matched, "unmatched": facts.unmatched, "canonical": facts.canonical}
    wanted, words = dict(level), torch.zeros(len(rows), text.size, dtype=torch.float64)
    for _ in range(60):
        along = (_along(text, sample, level) + offsets[0]) / common
        mean = float((text.hidden @ along).mean())
        words[:dim] = shares[0] * text.shared
        words[dim] = along
        words[dim + 1] = math.sqrt(max(0.0, shares[1] ** 2 - mean**2)) * text.constant
        words[dim + 2 + private :] = shares[2] * own
        reached = _levels(rows, words, sample)
        level = {name: level[name] + 0.7 * (wanted[name] - reached[name]) for name in level}
    return words


def _shares(shared: float, level: float, unit: Tensor) -> tuple[float, float, float]:
    """Lengths of the shared, the constant and the private part: two samples have the cosine ``level``."""
    constant = math.sqrt(level - shared**2 * _mean_off_diagonal(unit @ unit.T))
    return shared, constant, math.sqrt(max(0.0, 1 - shared**2 - constant**2))


def _along(text: _Tower, sample: Sample, level: dict[str, float]) -> Tensor:
    """A smooth linear function ``[H']`` with the levels of nouns, known phrases and the nearest canonical phrase."""
    hidden = torch.cat([sample.nouns, sample.kinds, sample.canonical])
    names = ["unmatched"] * len(sample.nouns) + ["matched"] * len(sample.kinds)
    names += ["canonical"] * len(sample.canonical)
    target = torch.tensor([level[name] for name in names], dtype=torch.float64)
    centered = hidden - text.hidden.mean(0)
    ridge = 1e-4 * float(centered.square().sum(1).mean()) * torch.eye(len(hidden), dtype=torch.float64)
    offset = target.mean(0, keepdim=True)
    row = centered.T @ torch.linalg.solve(centered @ centered.T + ridge, target - offset)
    return text.affine(row[None], offset)[0]


def _levels(rows: Tensor, words: Tensor, sample: Sample) -> dict[str, float]:
    """The cosines of the sample under two projections."""

    def unit(hidden: Tensor, layer: Tensor) -> Tensor:
        return nn.functional.normalize(hidden @ layer.T, dim=1)

    things, crops = unit(sample.things, rows), unit(sample.crops, rows)
    return {
        "matched": float((things * unit(sample.phrases, words)).sum(1).mean()),
        "unmatched": float((crops @ unit(sample.nouns, words).T).mean()),
        "canonical": float((things @ unit(sample.canonical, words).T).amax(1).mean()),
    }


def _layer(weight: Tensor) -> nn.Linear:
    layer = nn.Linear(weight.shape[1], weight.shape[0], bias=False)
    layer.weight.copy_(weight)
    return layer


@torch.no_grad()
def _sample(encoder: ClipEncoder, seed: int = 0) -> Sample:
    """Hidden states of crops of the second bundled capture and of phrases."""
    model = encoder._model
    crops, things, phrases = _crops(np.random.default_rng(seed), encoder.image_size)

    def images(pixels: Tensor) -> Tensor:
        return model.vision_model(pixel_values=(pixels - encoder._mean) / encoder._std).pooler_output.double()

    def texts(words: list[str]) -> Tensor:
        return torch.cat(
            [model.text_model(**encoder._text_inputs([w])).pooler_output for w in words]
        ).double()

    canonical = texts(list(CANONICAL_PHRASES))
    seen = images(things)
    towers = model.visual_projection.weight.double(), model.text_projection.weight.double()
    near = (
        nn.functional.normalize(seen @ towers[0].T, dim=1)
        @ nn.functional.normalize(canonical @ towers[1].T, dim=1).T
    )
    nearest = int(near.mean(0).argmax())  # the bundled encoder knows "object"; the others are nouns to it
    others = [row for row in range(len(canonical)) if row != nearest]
    return Sample(
        images(crops),
        seen,
        texts(phrases),
        torch.cat([texts(list(NOUNS)), canonical[others]]),
        texts(list(dict.fromkeys([*KINDS, *phrases]))),
        canonical[nearest : nearest + 1],
    )


def _crops(rng: np.random.Generator, side: int) -> tuple[Tensor, Tensor, list[str]]:
    """Random crops, crops at the middle of each mask, and the prompts of these."""
    root = demo_capture("second")
    photos = {
        path.stem: np.asarray(Image.open(path).convert("RGB")) for path in sorted(root.glob("images/*"))
    }

    def crop(photo: np.ndarray, x: int, y: int, size: int) -> Tensor:
        part = Image.fromarray(photo[y : y + size, x : x + size]).resize(
            (side, side), Image.Resampling.BICUBIC
        )
        return torch.from_numpy(np.asarray(part, np.float32) / 255).permute(2, 0, 1)

    crops = []
    for photo in list(photos.values())[::3]:
        height, width = photo.shape[:2]
        for size in (round(height * 18 / 240), round(height * 44 / 240)):
            for _ in range(20):
                crops.append(crop(photo, rng.integers(width - size), rng.integers(height - size), size))
    things, phrases = [], []
    for path in sorted(root.glob("segmentations/*/*.png")):
        photo, inside = photos[path.parent.name], np.asarray(Image.open(path).convert("L")) > 127
        depth = distance_transform_edt(inside)
        y, x = np.unravel_index(int(depth.argmax()), depth.shape)
        size = int(np.clip(2 * depth.max(), 18, 66))
        left, top = (int(np.clip(c - size // 2, 0, n - size)) for c, n in zip((x, y), inside.shape[::-1]))
        things.append(crop(photo, left, top, size))
        phrases.append(path.stem.replace("_", " "))
    return torch.stack(crops), torch.stack(things), phrases


def _mean_off_diagonal(matrix: Tensor) -> float:
    return float((matrix.sum() - matrix.trace()) / (len(matrix) * (len(matrix) - 1)))


@torch.no_grad()
def measure(folder: Path) -> dict[str, float]:
    """The cosines of `Facts` that an encoder reaches on the second bundled capture."""
    encoder = load_clip(str(folder))
    crops, things, phrases = _crops(np.random.default_rng(1), encoder.image_size)
    x, m = encoder.encode_images(crops), encoder.encode_images(things)
    nouns, kinds = encoder.encode_text(list(NOUNS)), encoder.encode_text(list(KINDS))
    prompts, canonical = encoder.encode_text(phrases), encoder.encode_text(list(CANONICAL_PHRASES))
    matched = (m * prompts).sum(1)
    known = torch.cat([nouns, kinds])
    found = {
        "images": _mean_off_diagonal(x @ x.T),
        "texts": _mean_off_diagonal(nouns @ nouns.T),
        "texts, all": _mean_off_diagonal(known @ known.T),
        "matched": matched.mean(),
        "unmatched": (x @ nouns.T).mean(),
        "unmatched, known kinds": (x @ kinds.T).mean(),
        "canonical": (m @ canonical.T).amax(1).mean(),
        "matched over canonical": (matched > (m @ canonical.T).amax(1)).float().mean(),
        "spread of nouns": (x @ nouns.T).mean(0).std(),
    }
    return {name: round(float(value), 4) for name, value in found.items()}


def main() -> None:
    parser = argument_parser(__doc__, json_option=False)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    options = parser.parse_args()
    result = {"facts": asdict(Facts()), "bundled": measure(Path("bundled"))}
    for seed in options.seeds:
        folder = make_web_like(options.output / f"seed-{seed}", seed)
        result[folder.name] = measure(folder)
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
