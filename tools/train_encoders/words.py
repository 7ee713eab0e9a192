"""The language of the bundled encoder: phrases, and the labels for which each is true. Needs numpy only.

A phrase is true, false, or open (neither: training skips it) of a `Label`, which is what a pixel shows: a
thing's kind, color and finish, and which part of it. Whether a phrase names what a crop shows follows from
the pixels around the crop's middle, see `crops.py`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

CANONICAL = ("object", "things", "stuff", "texture")
"""What LERF compares a prompt with; a phrase must beat all of them where it is true and none where it is false."""

NAMES: dict[str, tuple[str, ...]] = {
    "apple": ("apple",),
    "duck": ("rubber duck", "duck", "bath duck"),
    "mug": ("mug", "cup", "coffee mug", "tea cup"),
    "books": ("stack of books", "books", "book stack", "book"),
    "vase": ("vase", "flower vase", "ceramic vase"),
    "ring": ("ring", "hoop", "metal ring"),
    "cone": ("traffic cone", "cone", "road cone"),
    "plant": ("plant", "potted plant", "houseplant", "pot plant"),
    "lamp": ("lamp", "table lamp", "desk lamp"),
    "banana": ("banana",),
    "teddy": ("teddy bear", "teddy", "bear", "plush bear", "stuffed bear"),
    "ball": ("ball", "striped ball", "beach ball", "rubber ball"),
    "bowl": ("bowl", "dish", "ceramic bowl"),
    "candle": ("candle", "wax candle", "burning candle"),
    "bottle": ("bottle", "glass bottle", "wine bottle"),
    "pumpkin": ("pumpkin", "squash"),
    "car": ("toy car", "car", "model car"),
    "crate": ("wooden crate", "crate", "wooden box", "box"),
    "table": ("table", "table top", "desk"),
    "cloth": ("tablecloth", "cloth", "table cloth", "fabric"),
    "wall": ("wall", "back wall"),
    "floor": ("floor", "ground"),
}
"""Names of the 22 kinds, the usual one first."""

SYNONYMS: dict[str, tuple[str, ...]] = {
    "duck": ("toy duck",),
    "mug": ("cup", "coffee cup"),
    "books": ("pile of books",),
    "ring": ("hoop",),
    "plant": ("houseplant", "plant in a pot"),
    "lamp": ("desk lamp", "reading lamp"),
    "teddy": ("toy bear", "stuffed bear"),
    "ball": ("beach ball", "toy ball"),
    "bowl": ("dish",),
    "candle": ("burning candle",),
    "bottle": ("wine bottle",),
    "pumpkin": ("squash",),
    "car": ("little car", "model car"),
    "crate": ("wooden box",),
    "table": ("desk",),
    "cloth": ("fabric",),
    "floor": ("ground",),
}
"""Other names that the scores ask for; those not in ``NAMES`` never occur in training."""

PARTS: dict[str, tuple[str, ...]] = {
    "handle": ("handle",),
    "nose": ("nose",),
    "ears": ("ears", "ear"),
    "belly": ("belly",),
    "beak": ("beak", "bill"),
    "stalk": ("stalk", "stem"),
    "pot": ("pot", "flower pot"),
    "leaves": ("leaves", "foliage"),
    "stand": ("stand",),
    "shade": ("shade",),
    "flame": ("flame",),
    "saucer": ("saucer",),
    "cork": ("cork",),
    "wheels": ("wheels", "wheel", "tyres"),
}
OWNERS = {
    "handle": ("mug",),
    "nose": ("teddy",),
    "ears": ("teddy",),
    "belly": ("teddy",),
    "beak": ("duck",),
    "stalk": ("apple", "banana", "pumpkin"),
    "pot": ("plant",),
    "leaves": ("plant",),
    "stand": ("lamp",),
    "shade": ("lamp",),
    "flame": ("candle",),
    "saucer": ("candle",),
    "cork": ("bottle",),
    "wheels": ("car",),
}
"""Which kinds have the part."""
_IN_ITS_COLOR = {"handle", "ears", "leaves", "shade"}
"""Parts in the color of their thing; that of the others is open."""

COLORS: dict[str, tuple[str, ...]] = {
    "red": ("red",),
    "green": ("green",),
    "blue": ("blue",),
    "yellow": ("yellow",),
    "orange": ("orange",),
    "white": ("white",),
    "black": ("black",),
    "purple": ("purple",),
    "pink": ("pink",),
    "brown": ("brown",),
    "gray": ("gray", "grey"),
    "gold": ("gold", "golden"),
    "silver": ("silver",),
    "copper": ("copper",),
}
_NEAR = {frozenset(pair) for pair in (("gold", "yellow"), ("gold", "orange"), ("silver", "gray"), ("silver", "white"),
                                      ("copper", "orange"), ("copper", "brown"), ("gray", "white"),
                                      ("gold", "brown"), ("copper", "gold"), ("copper", "pink"))}  # fmt: skip
"""Colors that a look cannot tell apart with certainty: of each other they are open."""
HUES = {
    "red": 0, "copper": 20, "brown": 25, "orange": 30, "gold": 45, "yellow": 55, "green": 120, "blue": 220,
    "purple": 275, "pink": 340,
}  # fmt: skip
"""Degrees on the color circle; black, white, gray and silver have none."""
_NO_ONE_COLOR = {"books", "floor"}
"""Kinds of which color words are open: several colors at once."""


@dataclass(frozen=True)
class Label:
    """The label of a pixel."""

    kind: str
    color: str
    finish: str | None = None
    part: str | None = None


@dataclass(frozen=True)
class Quality:
    """A property that a phrase may ask for.

    Args:
        phrases: Full phrases that ask for it.
        adjectives: Words that go before a name.
        of: What has it: kinds, "KIND.PART" or "KIND:FINISH".
        open: Of what the phrase is open, in the same terms.
    """

    phrases: tuple[str, ...]
    adjectives: tuple[str, ...]
    of: tuple[str, ...]
    open: tuple[str, ...] = ()


QUALITIES: dict[str, Quality] = {
    "fruit": Quality(("fruit", "a piece of fruit", "some fruit"), (), ("apple", "banana")),
    "vegetable": Quality(("vegetable",), (), ("pumpkin",)),
    "food": Quality(("food", "something to eat"), (), ("apple", "banana", "pumpkin")),
    "drink": Quality(
        ("something to drink from", "something to drink coffee from", "drinking vessel"), (), ("mug",)
    ),
    "toy": Quality(("toy", "something to play with"), ("toy",), ("duck", "teddy", "ball", "car")),
    "animal": Quality(("toy animal", "animal"), (), ("duck", "teddy")),
    "vehicle": Quality(("vehicle", "toy vehicle"), (), ("car",)),
    "read": Quality(("something to read",), (), ("books",)),
    "light": Quality(
        ("something that gives light", "light source"), (), ("lamp", "candle.flame"), ("candle",)
    ),
    "metal": Quality(
        ("metal", "something made of metal", "something metallic"),
        ("metal", "metallic"),
        ("ring", "candle.saucer"),
    ),
    "shiny": Quality(
        ("something shiny",),
        ("shiny",),
        ("ring", "candle.saucer"),
        ("car", "mug", "vase", "bowl", "bottle", "apple", "ball", "duck"),
    ),
    "ceramic": Quality(("ceramic", "something made of ceramic"), ("ceramic",), ("mug", "vase", "bowl")),
    "glass": Quality(("glass", "something made of glass"), ("glass",), ("bottle",)),
    "wooden": Quality(
        ("wood", "something wooden", "something made of wood", "wooden surface"),
        ("wooden", "wood"),
        ("crate", "table:wooden"),
    ),
    "rubber": Quality(("something made of rubber", "rubber"), ("rubber",), ("duck", "ball", "car.wheels")),
    "plastic": Quality(
        ("something made of plastic", "plastic"), ("plastic",), ("cone",), ("car", "duck", "ball")
    ),
    "wax": Quality(("wax", "something made of wax"), ("wax",), ("candle",)),
    "paper": Quality(("paper", "something made of paper"), ("paper",), ("books",)),
    "fluffy": Quality(
        ("something fluffy", "something soft", "fur"), ("fluffy", "soft"), ("teddy",), ("cloth",)
    ),
    "leafy": Quality(("something leafy", "vegetation"), ("leafy",), ("plant",)),
    "brick": Quality(("bricks", "brick"), ("brick",), ("wall:brick",)),
    "stone": Quality(("stone tiles", "tiles"), ("tiled", "stone"), ("floor:tiled",), ("floor",)),
    "checkered": Quality(
        ("checkered pattern", "checkered fabric"), ("checkered",), ("cloth:checkered",), ("floor:tiled",)
    ),
    "striped": Quality(("stripes", "striped pattern"), ("striped",), ("ball",), ("cone", "cloth", "crate")),
    "plain": Quality(
        ("plain wall", "painted wall", "plaster"), ("plain", "painted"), ("wall:plain",), ("cloth",)
    ),
    "flowers": Quality(("something to put flowers in",), (), ("vase",)),
    "furniture": Quality(("furniture", "a piece of furniture"), (), ("table",), ("lamp",)),
}

HELD_OUT_PAIRS: frozenset[tuple[str, str]] = frozenset(
    {
        ("apple", "purple"),
        ("ball", "orange"),
        ("banana", "blue"),
        ("bottle", "pink"),
        ("bowl", "black"),
        ("candle", "green"),
        ("car", "white"),
        ("cone", "green"),
        ("crate", "red"),
        ("duck", "purple"),
        ("mug", "orange"),
        ("pumpkin", "white"),
        ("ring", "red"),
        ("teddy", "blue"),
        ("vase", "yellow"),
    }
)
"""Pairs that no training scene holds: what the encoder knows of them it has put together itself. None
stands in a scene that ships, so that those measure something else."""

_NOUNS = """
zebra airplane keyboard fridge elephant guitar bicycle tree dog cat horse laptop phone chair sofa bed
window door curtain carpet shoe hat umbrella backpack handbag tie suitcase frisbee ski kite bat glove
skateboard surfboard racket fork knife sandwich broccoli carrot pizza donut cake toilet television mouse
remote oven toaster sink clock scissors toothbrush truck bus train boat hydrant bench bird sheep cow
giraffe person face hand grass sky cloud sea river mountain bridge tower house church road rock sand
snow engine helmet jacket shirt trousers skirt sock belt watch camera radio speaker violin piano drum
trumpet flute microphone screen printer cable plug battery bulb mirror poster calendar map globe ruler
pencil pen eraser stapler envelope stamp newspaper magazine bread cheese egg milk butter rice pasta soup
salad tomato potato onion garlic pepper lemon juice grape pear peach cherry strawberry melon pineapple
coconut nut cookie candy chocolate cream fish crab lobster shrimp snail butterfly bee ant spider snake
lizard frog turtle dinosaur dragon robot rocket helicopter tractor tank ship anchor rope ladder hammer
saw drill wrench nail screw bolt gear spring chain lock key coin banknote wallet purse necklace earring
bracelet crown sword shield arrow gun statue pillow blanket towel soap shampoo comb razor perfume
lipstick medicine syringe bandage wheelchair crutch
"""
OTHER_WORDS = tuple(_NOUNS.split())
"""Nouns of things that no scene holds: every second one is trained to match nothing, the others test that."""
UNKNOWN_TRAINED = tuple(sorted(set(OTHER_WORDS)))[::2]
UNKNOWN_TESTED = tuple(sorted(set(OTHER_WORDS)))[1::2]

TEMPLATES = (
    "{}",
    "a photo of {}",
    "an image of {}",
    "a picture of {}",
    "a close up of {}",
    "a cropped photo of {}",
    "there is {} in the scene",
    "a render of {}",
)

TRUE, FALSE, OPEN = 1, 0, -1

_KNOWN_WORDS = frozenset(
    word
    for group in (
        NAMES, SYNONYMS, PARTS, COLORS, {"": OTHER_WORDS},
        {key: (*quality.phrases, *quality.adjectives) for key, quality in QUALITIES.items()},
    )
    for phrases in group.values()
    for phrase in phrases
    for word in phrase.split()
)  # fmt: skip


@dataclass(frozen=True)
class Phrase:
    """Words and their meaning; None means anything.

    Args:
        words: As a user would type them.
        kind: Key of ``NAMES``.
        color: Key of ``COLORS``.
        quality: Key of ``QUALITIES``.
        part: Key of ``PARTS``.
        unknown: Whether it names something that no scene holds.
    """

    words: str
    kind: str | None = None
    color: str | None = None
    quality: str | None = None
    part: str | None = None
    unknown: bool = False

    def of(self, label: Label) -> int:
        """``TRUE``, ``FALSE`` or ``OPEN`` of a label."""
        if self.unknown:
            return FALSE
        answers = []
        if self.kind is not None:
            answers.append(TRUE if self.kind == label.kind else FALSE)
        if self.part is not None:
            answers.append(TRUE if self.part == label.part else FALSE)
        if self.quality is not None:
            answers.append(_has_quality(QUALITIES[self.quality], label))
        if self.color is not None:
            # A name with a color is about the whole thing; a color alone is about what is seen.
            whole = self.kind is not None and self.part is None
            answers.append(_has_color(self.color, label, whole))
        if FALSE in answers:
            return FALSE
        return OPEN if OPEN in answers else TRUE


def _has_quality(quality: Quality, label: Label) -> int:
    terms = {label.kind, f"{label.kind}:{label.finish}", f"{label.kind}.{label.part}"}
    if terms & set(quality.of):
        return TRUE
    return OPEN if terms & set(quality.open) else FALSE


def _has_color(color: str, label: Label, whole: bool) -> int:
    if label.kind in _NO_ONE_COLOR:
        return OPEN
    if not whole and label.part is not None and label.part not in _IN_ITS_COLOR:
        return OPEN
    if not whole and label.kind in ("plant", "lamp") and label.part is None:
        return OPEN  # soil and bulb
    if color == label.color:
        return TRUE
    if frozenset((color, label.color)) in _NEAR:
        return OPEN
    if label.kind in ("ball", "cloth", "cone", "wall"):  # a second color shows
        return FALSE if whole else OPEN
    return FALSE


def with_article(words: str, rng: np.random.Generator) -> str:
    """``words`` with "a", "an", "the" or nothing before it."""
    if words.startswith(("a ", "some")) or words.endswith("s") or rng.random() > 0.7:
        return words
    if rng.random() < 0.25:
        return f"the {words}"
    return f"an {words}" if words[0] in "aeiou" else f"a {words}"


def in_sentence(phrase: Phrase, rng: np.random.Generator, plain: float = 0.5) -> str:
    """The phrase as typed, with probability ``plain``, or within a sentence."""
    if rng.random() < plain:
        return phrase.words
    return TEMPLATES[int(rng.integers(len(TEMPLATES)))].format(with_article(phrase.words, rng))


def phrase_for(label: Label, rng: np.random.Generator) -> Phrase:
    """A phrase that is true of the label."""
    for _ in range(20):
        phrase = _random_phrase(label.kind, label.color, label.part, rng)
        if phrase.of(label) == TRUE:
            return phrase
    return Phrase(_pick(NAMES[label.kind], rng), kind=label.kind)


def near_miss(label: Label, rng: np.random.Generator) -> Phrase:
    """A phrase that is close to the label but false: another color, kind or part."""
    draw = rng.random()
    kind, color, part = label.kind, label.color, label.part
    if draw < 0.4:
        color = _pick(tuple(c for c in COLORS if (kind, c) not in HELD_OUT_PAIRS), rng)
        return colored(kind, color, rng)
    if draw < 0.7:
        kind = _pick(tuple(k for k in NAMES if (k, color) not in HELD_OUT_PAIRS), rng)
        return colored(kind, color, rng)
    if draw < 0.85:
        parts = tuple(known for known, owners in OWNERS.items() if kind in owners)
        if parts:
            return _part_phrase(kind, _pick(parts, rng), rng)
    return _random_phrase(kind, _pick(tuple(COLORS), rng), part, rng)


def any_phrase(rng: np.random.Generator) -> Phrase:
    """Any phrase, also of objects that no image shows."""
    if rng.random() < 0.3:
        word = _pick(UNKNOWN_TRAINED, rng) if rng.random() < 0.6 else _made_up_word(rng)
        color = f"{_pick(tuple(COLORS), rng)} " if rng.random() < 0.4 else ""
        return Phrase(color + word, unknown=True)
    return _random_phrase(_pick(tuple(NAMES), rng), _pick(tuple(COLORS), rng), None, rng)


def colored(kind: str, color: str, rng: np.random.Generator) -> Phrase:
    """A name of the kind after a word for the color."""
    words = f"{_pick(COLORS[color], rng)} {_pick(NAMES[kind], rng)}"
    return Phrase(words, kind=kind, color=color)


def parallelogram(rng: np.random.Generator) -> list[str]:
    """Two kinds in two colors, as texts (k c, k d, l c, l d): what sets colors apart should not hang on the kind.

    Pairs that training images lack are among them: their words may be read, what they look like may not be seen.
    """
    kind, other = rng.choice([name for name in NAMES if name not in _NO_ONE_COLOR], 2, replace=False)
    color, tint = rng.choice(list(COLORS), 2, replace=False)
    return [f"{c} {NAMES[str(k)][0]}" for k in (kind, other) for c in (color, tint)]


def _part_phrase(kind: str, part: str, rng: np.random.Generator) -> Phrase:
    name, word, form = _pick(NAMES[kind], rng), _pick(PARTS[part], rng), rng.random()
    if form < 0.55:
        return Phrase(f"{name.split()[-1]} {word}", kind=kind, part=part)
    if form < 0.75:
        return Phrase(word, part=part)
    return Phrase(f"{word} of {with_article(name, rng)}", kind=kind, part=part)


def any_part(rng: np.random.Generator, handles: int = 1) -> Phrase:
    """A phrase about any part of anything that has it; ``handles`` times as often as any other about a handle."""
    part = _pick(tuple(part for part in OWNERS for _ in range(handles if part == "handle" else 1)), rng)
    return _part_phrase(_pick(OWNERS[part], rng), part, rng)


_ONSETS = (*"bcdfghklmnprstvw", "br", "cl", "dr", "fl", "gr", "pl", "sh", "st", "tr")
_VOWELS, _CODAS = (*"aeiou", "ea", "oo", "ai"), tuple("nrltkms")


def _made_up_word(rng: np.random.Generator) -> str:
    """A made-up word: unknown words should match nothing."""
    while True:
        count = int(rng.integers(1, 4))
        word = "".join(_pick(_ONSETS, rng) + _pick(_VOWELS, rng) for _ in range(count)) + _pick(_CODAS, rng)
        if word not in _KNOWN_WORDS:
            return word


def _random_phrase(kind: str, color: str, part: str | None, rng: np.random.Generator) -> Phrase:
    """A phrase of a random form about these."""
    name, tint = _pick(NAMES[kind], rng), _pick(COLORS[color], rng)
    if part is None and rng.random() < 0.08:
        parts = [known for known, owners in OWNERS.items() if kind in owners]
        part = _pick(tuple(parts), rng) if parts else None
    if part is not None and part in PARTS and rng.random() < 0.7:
        return _part_phrase(kind, part, rng)
    form = rng.random()
    if form < 0.3 or (form < 0.66 and (kind, color) in HELD_OUT_PAIRS):
        # As the name of a held-out pair could only be wrong, it would be learnt as the name of nothing.
        return Phrase(name, kind=kind)
    if form < 0.66:
        return Phrase(f"{tint} {name}", kind=kind, color=color)
    if form < 0.75:
        words = _pick((f"something {tint}", tint, f"{tint} thing", f"{tint} object"), rng)
        return Phrase(words, color=color)
    quality = _pick(tuple(QUALITIES), rng)
    mine = [
        key
        for key, value in QUALITIES.items()
        if any(term.split(":")[0].split(".")[0] == kind for term in value.of)
    ]
    if mine and rng.random() < 0.8:
        quality = _pick(tuple(mine), rng)
    wanted = QUALITIES[quality]
    if wanted.adjectives and rng.random() < 0.45:
        adjective = _pick(wanted.adjectives, rng)
        if adjective not in name:
            return Phrase(f"{adjective} {name}", kind=kind, quality=quality)
    return Phrase(_pick(wanted.phrases, rng), quality=quality)


def _pick(options: tuple[str, ...], rng: np.random.Generator) -> str:
    return options[int(rng.integers(len(options)))]
