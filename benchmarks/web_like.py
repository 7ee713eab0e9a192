"""Encoders with the statistics of a CLIP trained on the web, made from the bundled one.

    python benchmarks/web_like.py --output output/web_like --seeds 0 1 2

The last layers of the bundled CLIP are replaced (`make_web_like`): what images and texts share is scaled down, each
tower gets a common direction and directions that the other tower lacks, and each word an offset. The result is an
ordinary folder of transformers for ``--clip FOLDER``. It knows what the bundled encoder knows, in a narrow cone: what
a scene loses with it is lost to numbers that suit one encoder only.

Prints the cosines that are reached (`measure`), twice: for the phrases and the capture of the fit, and for those that
had no part in it. ``--check FOLDER`` measures other encoders.
"""

from __future__ import annotations

import copy
import json
import math
import shutil
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from records import argument_parser
from safetensors.torch import load_file, save_file
from scipy.ndimage import distance_transform_edt
from torch import Tensor, nn

from lexsplat.evaluation.demo import demo_capture
from lexsplat.features.clip import ClipEncoder
from lexsplat.features.encoders import load_clip
from lexsplat.features.hub import model_folder
from lexsplat.features.text import load_text
from lexsplat.queries.everyday import everyday_words
from lexsplat.queries.relevancy import CANONICAL_PHRASES
from lexsplat.queries.vocabulary import COLORS, words

KINDS = (
    "apple", "rubber duck", "mug", "stack of books", "vase", "ring", "traffic cone", "potted plant",
    "table lamp", "banana", "teddy bear", "striped ball", "bowl", "candle", "bottle", "pumpkin",
    "toy car", "wooden crate", "table", "cloth", "wall",
)  # fmt: skip
"""Names of the kind that the bundled encoder knows."""
OTHERS = ("fruit", "something made of metal", "something to drink from")
"""Other phrases that it knows."""
MATERIALS = words(
    "wooden, metal, plastic, glass, stone, leather, paper, rubber, ceramic, striped, checkered, old, small"
)
PARTS = words("""handle, lid, cap, spout, neck, rim, knob, stem, leaf, petal, shade, cord, string, flame, wick, spine,
    page, button, sole, lace, wing, beak, nose, ear, eye, mouth, tail, paw, foot, leg, arm""")
NAMES = 4
"""Form of the names that the bundled encoder knows, alone (`Phrases`)."""

CROPS = (18 / 240, 44 / 240)
"""Sizes of crops, as shares of the height of a photo."""
EVENED = 0.25
"""Exponent on the variances of hidden states that private directions divide by; 0.5 would make them white."""

_IMAGES, _TEXTS = "visual_projection.weight", "text_projection.weight"


@dataclass(frozen=True)
class Facts:
    """Mean cosines of a CLIP trained on the web, which `make_web_like` aims at.

    Args:
        images: Of two crops.
        texts: Of two phrases.
        matched: Of a crop and its phrase.
        unmatched: Of a crop and any phrase.
        canonical: Of a crop and the nearest canonical phrase.
        offset: Standard deviation of the offsets of phrases, as a share of matched minus unmatched. An offset is the
            part of a phrase's mean cosine with crops that does not come from what images and texts share.
    """

    images: float = 0.5
    texts: float = 0.75
    matched: float = 0.28
    unmatched: float = 0.18
    canonical: float = 0.21
    offset: float = 0.2

    @property
    def signal(self) -> float:
        """Matched minus unmatched."""
        return self.matched - self.unmatched


@dataclass(frozen=True)
class Phrases:
    """General phrases: names of things alone, with a color, with a material, and with a part.

    Args:
        texts: The phrases.
        forms: Of each ``[P]``: 0 to 3 for names that the bundled encoder does not know, 4 to 7 for those it knows.
    """

    texts: tuple[str, ...]
    forms: Tensor

    @property
    def known(self) -> Tensor:
        """Which phrases ``[P]`` the bundled encoder knows."""
        return self.forms >= NAMES

    @property
    def weights(self) -> Tensor:
        """Weights ``[P]``, 1 on average: what the bundled encoder knows counts as much as what it does not."""
        share = self.known.double().mean()
        return torch.where(self.known, 0.5 / share, 0.5 / (1 - share))


def general_phrases(held_out: bool) -> Phrases:
    """Half of about six thousand phrases: those of the fit, or those that have no part in it."""
    others = [[f"{word} {{}}" for word in sorted(COLORS)], [f"{word} {{}}" for word in MATERIALS]]
    others.append([f"{{}} {part}" for part in sorted(PARTS)])
    forms = dict.fromkeys((*KINDS, *OTHERS), NAMES)
    for form, patterns in enumerate(others, start=NAMES + 1):
        forms.update({pattern.format(kind): form for pattern in patterns for kind in KINDS})
    for place, word in enumerate(everyday_words()):
        for form, patterns in enumerate([["{}"], *others]):
            forms.setdefault(patterns[place // (7 if form > 1 else 1) % len(patterns)].format(word), form)
    coins = (torch.rand(len(forms), generator=torch.Generator().manual_seed(1)) < 0.5).tolist()
    drawn = [item for item, coin in zip(forms.items(), coins) if coin is held_out]
    return Phrases(tuple(phrase for phrase, _ in drawn), torch.tensor([form for _, form in drawn]))


@dataclass(frozen=True)
class Sample:
    """Hidden states before the last layer of the bundled CLIP.

    Args:
        crops: Of random crops ``[C, H]``.
        varied: Of random crops in other sizes, colors and lights ``[V, H]``.
        things: Of crops of things ``[M, H]``.
        names: Of the prompt of each ``[M, H']``.
        phrases: Of general phrases ``[P, H']``.
        canonical: Of the canonical phrases ``[4, H']``.
    """

    crops: Tensor
    varied: Tensor
    things: Tensor
    names: Tensor
    phrases: Tensor
    canonical: Tensor


@torch.no_grad()
def make_web_like(
    folder: Path, seed: int = 0, facts: Facts = Facts(), private: int = 30, each: int = 20
) -> Path:
    """Save an encoder with the statistics of a web-trained CLIP as a folder of transformers.

    An image is ``Q (s x + a e + p y)``: x is the bundled embedding, e a constant, y its private directions, and Q a
    random rotation. A text is the same with its own constants, and with an offset along the images' constant, a
    linear function of its hidden state. Another such function makes up for the lengths of private parts: s x is the
    same share of every text.

    Args:
        folder: Where it is written.
        seed: Of rotation, private directions and offsets.
        facts: What to imitate.
        private: Number of private dimensions of each tower.
        each: Crops of each of two sizes in a photo; variations have twice as many.
    """
    bundled = load_clip("bundled")
    if not isinstance(bundled, ClipEncoder):
        raise TypeError("the bundled encoder is a ClipEncoder")
    phrases = general_phrases(held_out=False)
    source = Path(model_folder("bundled", "clip"))
    tensors = {name: value.float() for name, value in load_file(source / "model.safetensors").items()}
    sample = _sample(bundled, phrases.texts, each)
    draw = torch.Generator().manual_seed(seed)
    image = _Tower(tensors, "vision_model.post_layernorm", _IMAGES, sample.varied)
    text = _Tower(tensors, "text_model.final_layer_norm", _TEXTS, sample.phrases, phrases.weights)

    dim, shared = len(image.weight), 0.5
    unit = image.unit(sample.crops)
    constant = math.sqrt(facts.images - shared**2 * _mean_off_diagonal(unit @ unit.T))
    width = dim + 2 + 2 * private
    rotation = torch.linalg.qr(torch.randn(width, width, generator=draw, dtype=torch.float64))[0]
    rows = torch.zeros(width, image.size, dtype=torch.float64)
    rows[:dim] = shared * image.shared
    rows[dim] = constant * image.constant
    rows[dim + 2 : dim + 2 + private] = math.sqrt(1 - shared**2 - constant**2) * image.private(private, draw)
    offset = facts.offset * facts.signal * text.private(1, draw)[0]
    words = _text_rows(text, sample, facts, rows, (text.private(private, draw), offset), phrases.forms)
    for name, projection in ((_IMAGES, rows), (_TEXTS, words)):
        tensors[name] = (rotation @ projection).float().contiguous()
    folder.mkdir(parents=True, exist_ok=True)
    for path in source.glob("*.json"):
        shutil.copy(path, folder)
    config = json.loads((source / "config.json").read_text())
    for part in (config, config["text_config"], config["vision_config"]):
        part["projection_dim"] = width
    (folder / "config.json").write_text(json.dumps(config, indent=2))
    save_file(tensors, folder / "model.safetensors", {"format": "pt"})
    return folder


class _Tower:
    """The last layers of a tower as linear functions of its normalized hidden state."""

    def __init__(
        self,
        tensors: dict[str, Tensor],
        norm: str,
        projection: str,
        hidden: Tensor,
        weights: Tensor | None = None,
    ) -> None:
        self.weight = tensors[projection].double()
        self.size = self.weight.shape[1]
        self.hidden = hidden
        self.weights = torch.ones(len(hidden), dtype=torch.float64) if weights is None else weights
        self.shared = self.weight / self.mean((hidden @ self.weight.T).norm(dim=1))
        # LN(h) = gamma z + beta with sum z = 0: the row 1 / gamma sees the constant sum(beta / gamma) only.
        row = 1 / tensors[f"{norm}.weight"].double()
        self.constant = row / float((tensors[f"{norm}.bias"].double() * row).sum())
        self.middle = self.weights @ hidden / len(hidden)
        self.centered = hidden - self.middle
        self.covariance = self.centered.T @ (self.weights[:, None] * self.centered) / len(hidden)

    def unit(self, hidden: Tensor) -> Tensor:
        return _unit(hidden, self.weight)

    def mean(self, values: Tensor) -> float:
        return float(self.weights @ values) / len(values)

    def affine(self, rows: Tensor, offset: float = 0.0) -> Tensor:
        """Rows ``[R, H]`` of the functions ``rows (h - middle) + offset``."""
        return rows + (offset - rows @ self.middle)[:, None] * self.constant

    def fitted(self, values: Tensor) -> Tensor:
        """The linear function ``[H]`` that comes nearest to values ``[P]`` at the hidden states."""
        offset = self.mean(values)
        return self.affine(
            self._solved(self.centered.T @ (self.weights * (values - offset)) / len(values)), offset
        )[0]

    def mark(self, hidden: Tensor) -> Tensor:
        """The linear function ``[H]`` that is 1 at a hidden state ``[H]`` and as small as can be at the others."""
        row = self._solved(hidden - self.middle)
        return self.affine(row / (row @ (hidden - self.middle)))[0]

    def private(self, count: int, draw: torch.Generator) -> Tensor:
        """Random functions of the hidden state; their vector has length 1 in root mean square.

        They read what the projection does not, if there is enough. Variances are evened out halfway: functions of
        white states are far longer at states unlike those that they are fitted to.
        """
        unread = torch.linalg.svd(self.weight)[2][len(self.weight) :]
        read = unread if len(unread) >= count else torch.eye(self.size, dtype=torch.float64)
        values, vectors = torch.linalg.eigh(read @ self.covariance @ read.T)
        even = vectors * values.clamp_min(1e-4 * float(values[-1])) ** -EVENED
        rows = torch.linalg.qr(torch.randn(len(read), count, generator=draw, dtype=torch.float64))[0].T
        rows = rows @ even.T @ read
        return self.affine(rows / self.mean((self.centered @ rows.T).square().sum(1)) ** 0.5)

    def _solved(self, moment: Tensor) -> Tensor:
        ridge = 1e-3 * float(self.covariance.trace()) / self.size * torch.eye(self.size, dtype=torch.float64)
        return torch.linalg.solve(self.covariance + ridge, moment)[None]


def _text_rows(
    text: _Tower, sample: Sample, facts: Facts, rows: Tensor, drawn: tuple[Tensor, Tensor], forms: Tensor
) -> Tensor:
    """The text tower's projection that reaches the levels of ``facts`` beside the image tower's ``rows``.

    Mean cosines of the forms of phrases are evened out. ``drawn`` are private directions and the offset of phrases.
    """
    dim, (own, offset) = len(text.weight), drawn
    crops, things = _unit(sample.crops, rows), _unit(sample.things, rows)
    middle, common = crops.mean(0), float(crops[:, dim].mean())
    lengths, level = (text.hidden @ text.shared.T).norm(dim=1), text.unit(text.hidden) @ middle[:dim]
    form_offset = text.hidden @ offset  # offsets are of single phrases: what a form shares is taken away
    for values in (level, form_offset):
        for form in forms.unique():
            values[forms == form] = values[forms == form].mean()
    privates = (text.hidden @ own.T).square().sum(1)
    # The bundled encoder knows one of the canonical phrases, "object".
    nearest = int((things[:, :dim] @ text.unit(sample.canonical).T).mean(0).argmax())
    mark = text.mark(sample.canonical[nearest])

    names = (things[:, :dim] * text.unit(sample.names)).sum(1).mean() - level[forms == NAMES].mean()
    shared = facts.signal / float(names)
    unmatched, canonical, length = facts.unmatched, 0.0, 0.4
    words = torch.zeros(len(rows), text.size, dtype=torch.float64)
    for _ in range(80):  # normalization couples the levels: they are corrected until they hold
        along = text.fitted(lengths * (unmatched - shared * level) - form_offset) + offset + canonical * mark
        words[:dim] = shared * text.shared
        words[dim] = along / common
        rest = (1 - shared**2) * lengths**2 - length**2 * privates - (text.hidden @ words[dim]).square()
        words[dim + 1] = text.fitted(rest.clamp_min(0.04).sqrt())
        words[-len(own) :] = length * own

        units = _unit(text.hidden, words)
        mean = text.weights @ units / len(units)
        nearby = float((things @ _unit(sample.canonical, words).T).amax(1).mean())
        unmatched += 0.7 * (facts.unmatched - float(mean @ middle))
        canonical += 0.7 * (facts.canonical - nearby)
        length = max(0.0, length + 0.5 * (float(mean @ mean) - facts.texts))
    return words


def _unit(hidden: Tensor, layer: Tensor) -> Tensor:
    return nn.functional.normalize(hidden @ layer.T, dim=1)


@torch.no_grad()
def _sample(encoder: ClipEncoder, phrases: Sequence[str], each: int, seed: int = 0) -> Sample:
    """Hidden states of crops of the second bundled capture and of phrases."""
    rng = np.random.default_rng(seed)
    photos, side = _photos(demo_capture("second") / "images"), encoder.image_size
    seen, heard = copy.copy(encoder._images), copy.copy(encoder._texts)
    if seen is None or heard is None:
        raise TypeError("the bundled encoder has both towers of CLIP's own architecture")
    seen._project, heard._projected = nn.Identity(), lambda hidden: hidden

    def images(pixels: Tensor) -> Tensor:
        parts = ((pixels - encoder._mean) / encoder._std).split(200)
        return torch.cat([seen(part, patches=False)[:, 0] for part in parts]).double()

    def texts(words: Sequence[str]) -> Tensor:
        return heard.encode_together(words).double()

    things, names = thing_crops(demo_capture("second"), side)
    return Sample(
        images(random_crops(photos[::3], rng, side, each)),
        images(random_crops(photos[::2], rng, side, 2 * each, varied=True)),
        images(things),
        texts(names),
        texts(phrases),
        texts(CANONICAL_PHRASES),
    )


def _photos(folder: Path, places: slice = slice(None)) -> list[Image.Image]:
    return [Image.open(path).convert("RGB") for path in sorted(folder.glob("*.[jJpP]*"))[places]]


def random_crops(
    photos: Sequence[Image.Image], rng: np.random.Generator, side: int, each: int = 20, varied: bool = False
) -> Tensor:
    """Crops ``[C, 3, side, side]`` in 0..1 anywhere in photos.

    Args:
        photos: The photos.
        rng: Where and how.
        side: Pixels of a crop.
        each: Crops of each of two sizes in each photo.
        varied: Vary their sizes, hues, saturations and brightness, and mirror half of them.
    """
    crops = []
    for photo in photos:
        for share in CROPS:
            for _ in range(each):
                size = round(photo.height * share * (math.exp(rng.uniform(-0.4, 0.4)) if varied else 1))
                x, y = int(rng.integers(photo.width - size)), int(rng.integers(photo.height - size))
                crop = photo.crop((x, y, x + size, y + size))
                crops.append(_pixels(_varied(crop, rng) if varied else crop, side))
    return torch.from_numpy(np.stack(crops)).permute(0, 3, 1, 2)


def _varied(crop: Image.Image, rng: np.random.Generator) -> Image.Image:
    hue, saturation, value = np.moveaxis(np.asarray(crop.convert("HSV")).astype(np.float64), 2, 0)
    hue = (hue + rng.integers(256) * (rng.random() < 0.7)) % 256
    saturation, value = saturation * rng.uniform(0.3, 1.6), value * rng.uniform(0.5, 1.5)
    channels = np.stack([hue, saturation, value], 2)[:, :: rng.choice((-1, 1))]
    return Image.fromarray(channels.clip(0, 255).astype(np.uint8), "HSV").convert("RGB")


def _pixels(crop: Image.Image, side: int) -> NDArray[np.float32]:
    return np.asarray(crop.resize((side, side), Image.Resampling.BICUBIC), np.float32) / 255


def thing_crops(capture: Path, side: int) -> tuple[Tensor, list[str]]:
    """Crops ``[M, 3, side, side]`` at the middle of each mask of a capture, and their prompts."""
    crops, prompts = [], []
    for folder in sorted(capture.glob("segmentations/*/")):
        photo = Image.open(capture / "images" / f"{folder.name}.jpg").convert("RGB")
        for path in sorted(folder.glob("*.png")):
            (x, y), depth = _deepest(np.asarray(Image.open(path).convert("L")) > 127)
            size = int(np.clip(2 * depth, 0.075 * photo.height, 0.275 * photo.height))
            left, top = (int(np.clip(c - size // 2, 0, n - size)) for c, n in zip((x, y), photo.size))
            crops.append(_pixels(photo.crop((left, top, left + size, top + size)), side))
            prompts.append(path.stem.replace("_", " "))
    return torch.from_numpy(np.stack(crops)).permute(0, 3, 1, 2), prompts


def _deepest(inside: NDArray[np.bool_]) -> tuple[tuple[int, int], float]:
    """Column and row of the pixel of a mask that is farthest from its outside, and how far it is."""
    rows, columns = (np.flatnonzero(inside.any(axis)) for axis in (1, 0))
    # The nearest pixel outside is at most one beyond the box of the mask.
    first = max(rows[0] - 1, 0), max(columns[0] - 1, 0)
    depth = distance_transform_edt(inside[first[0] : rows[-1] + 2, first[1] : columns[-1] + 2])
    row, column = np.unravel_index(int(depth.argmax()), depth.shape)
    return (int(first[1] + column), int(first[0] + row)), float(depth.max())


def _mean_off_diagonal(matrix: Tensor) -> float:
    return float((matrix.sum() - matrix.trace()) / (len(matrix) * (len(matrix) - 1)))


@torch.no_grad()
def measure(folder: Path, held_out: bool, each: int = 20) -> dict[str, float]:
    """The cosines of `Facts` that an encoder reaches, measured on this many crops of each of two sizes in a photo.

    Those of the fit are measured on the second bundled capture; those held out on the other one, with the other half
    of the general phrases. A gain is how far the cosines of a known phrase vary over crops, as a slope over those of
    the bundled encoder, both relative to the mean over all phrases. ``gain`` is its mean over phrases, ``spread of
    gains`` its standard deviation as a share of the mean.
    """
    encoder, bundled, phrases = load_clip(str(folder)), load_clip("bundled"), general_phrases(held_out)
    capture = demo_capture("tabletop" if held_out else "second")
    pixels, names = thing_crops(capture, encoder.image_size)
    random = random_crops(
        _photos(capture / "images")[1::3], np.random.default_rng(1), encoder.image_size, each
    )
    weights = phrases.weights / len(phrases.texts)
    crops, things = encoder.encode_images(random).double(), encoder.encode_images(pixels).double()
    towers = (load_text(name) for name in (str(folder), "bundled"))
    texts, plain = (
        getattr(each, "encode_together", each.encode_text)(list(phrases.texts)).double() for each in towers
    )
    canonical = encoder.encode_text(list(CANONICAL_PHRASES)).double()
    cosines, middle = crops @ texts.T, weights @ texts
    level = cosines.mean(0)
    plain = bundled.encode_images(random).double() @ plain.T
    varied, shared = ((each - (each @ weights)[:, None])[:, phrases.known] for each in (cosines, plain))
    shared = shared - shared.mean(0)
    gains = (varied * shared).sum(0) / shared.square().sum(0)
    explained = torch.cat([plain.mean(0)[:, None], nn.functional.one_hot(phrases.forms).double()], 1)
    root = weights.sqrt()[:, None]
    offsets = root * (
        level[:, None] - explained @ torch.linalg.lstsq(root * explained, root * level[:, None])[0]
    )
    nearest = (things @ canonical.T).amax(1)
    known = sorted(set(names))
    matched = (things * encoder.encode_text(known).double()[[known.index(name) for name in names]]).sum(1)
    found = {
        "images": _mean_off_diagonal(crops @ crops.T),
        "texts": middle @ middle,
        "matched": matched.mean(),
        "unmatched": weights @ level,
        "canonical": nearest.mean(),
        "offset": offsets.square().sum().sqrt(),
        "gain": gains.mean(),
        "spread of gains": gains.std() / gains.mean(),
        "matched over canonical": (matched > nearest).double().mean(),
    }
    return {name: round(float(value), 4) for name, value in found.items()}


def main() -> None:
    parser = argument_parser(__doc__, json_option=False)
    parser.add_argument("--output", type=Path, help="where the encoders are written")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--check", type=Path, nargs="+", default=[Path("bundled")], help="measure these, too")
    options = parser.parse_args()
    folders = list(options.check)
    if options.output:
        folders += [make_web_like(options.output / f"seed-{seed}", seed) for seed in options.seeds]
    result: dict[str, object] = {"facts": asdict(Facts())}
    for folder in folders:
        result[str(folder)] = {"fit": measure(folder, False), "held out": measure(folder, True)}
        print(f"{folder}: measured", file=sys.stderr)
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
