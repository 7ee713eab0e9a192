"""Everyday names: for "thing", for the correction of typing errors, and for suggestions of the viewer."""

from __future__ import annotations

_EVERYDAY = """
    apple, banana, orange, lemon, pear, bread, cake, cookie, cheese, egg, cup, mug, glass, bottle, bowl,
    plate, teapot, spoon, fork, knife, pan, jar, box, basket, bag, book, newspaper, pen, paper, lamp,
    candle, clock, vase, flower, potted plant, leaves, grass, tree, bush, stone, brick, wall, floor,
    ceiling, window, door, curtain, carpet, cushion, blanket, tablecloth, table, chair, sofa, bench,
    shelf, cabinet, bed, desk, computer keyboard, computer mouse, screen, phone, camera, headphones,
    cable, shoe, hat, shirt, glove, umbrella, backpack, ball, toy car, toy bulldozer, stuffed animal,
    rubber duck, doll, bicycle, car, road, sky, water, sand, wood, metal, plastic, cloth, cat,
    dog, bird, person, hand, picture, mirror, stairs, fence, statue, sign, ring, cone, cube, drum,
    guitar, piano
"""
_BUNDLED = """
    apple, rubber duck, mug, stack of books, vase, ring, traffic cone, potted plant, table lamp, banana, teddy bear,
    striped ball, bowl, candle, bottle, pumpkin, toy car, wooden crate, table, tablecloth, wall, floor
"""
_COLORS = """
    red, green, blue, yellow, orange, white, black, purple, pink, brown, gray, gold, silver
"""
_QUALITIES = """
    grey, golden, copper, wooden, metal, metallic, ceramic, glass, rubber, plastic, wax, paper, stone, brick,
    striped, checkered, plain, painted, shiny, soft, fluffy, leafy, tiled, potted, burning, round, square, flat,
    big, small, large, little, tall, dark, bright, transparent, colorful
"""
_STATES = """
    open, closed, shut, locked, empty, full, broken, wet, dry, dirty, clean, old, new, dead, alive, lit, ripe, unripe,
    rotten, fresh, hot, cold, warm, heavy, cute, happy, sad, expensive, cheap, real, fake, edible, fragile, rusty,
    dusty, asleep, awake, frozen, melted, dangerous, comfortable, useful
"""
_PARTS = """
    handle, lid, cap, spout, neck, rim, knob, stem, stalk, leaf, petal, shade, cord, string, flame, wick, cork,
    spine, page, button, sole, lace, wheel, tire, roof, wing, beak, head, face, nose, ear, eye, mouth, tail, belly,
    paw, foot, leg, arm, stand, base
"""
_MATERIALS = """
    wood, metal, plastic, stone, brick, rubber, leather, fabric, wool, cotton, silk, denim, fur, porcelain, ceramic,
    clay, concrete, gold, silver, copper, steel, rust, wax, foam, paper, cardboard, stripes, checkered pattern,
    polka dots, text
"""
_DIVIDED = """
    table, tablecloth, desk, cloth, wall, floor, ceiling, carpet, grass, road, stairs, ground, shelf, bed
"""
_OTHER_SURFACES = """
    sky, water, sand, wood, metal, plastic, stone, brick, leaves, window, door, curtain, fence, hand, wheel
"""


def words(text: str) -> list[str]:
    """Phrases separated by commas, with single spaces."""
    return [" ".join(entry.split()) for entry in text.split(",")]


DIVIDED = frozenset(words(_DIVIDED))
"""Names of surfaces that the things on them, or before them, divide into pieces."""
CARRIERS = DIVIDED - {"wall", "ceiling"}
"""Names of surfaces that things stand on."""
SURFACES = DIVIDED | frozenset(words(_OTHER_SURFACES))
"""Names of surfaces, materials and parts: none of them is a "thing" when everything is asked for."""
MATERIALS = frozenset(words(_MATERIALS))
"""Names of materials and patterns, which give way to the name of a thing."""
STUFF = frozenset({"wall", "floor", "ceiling", "ground", "road", "sky", "water", "grass", "sand", "carpet"})
"""Names of surfaces that are one, however the things in front of them divide what can be seen of them."""
NAMES = frozenset(entry.split(" of ")[0].split()[-1] for entry in words(_EVERYDAY) + words(_BUNDLED)) - {
    "wood",
    "metal",
}
"""The nouns of all everyday names."""
PARTS = frozenset(words(_PARTS))
"""Nouns that name a part behind its thing, which compounds such as "candle holder" do not."""
COLORS = frozenset(words(_COLORS))
"""Words of colors."""
STATES = frozenset(words(_STATES))
"""Adjectives that photos may not tell."""
QUALITIES = frozenset(words(_QUALITIES)) | COLORS | STATES
"""Adjectives that may follow their noun: "is the mug red", "vase, white"."""


def is_divided(phrase: str) -> bool:
    """Whether a phrase names one of `DIVIDED`, and not a union or a relation of such."""
    *before, noun = phrase.lower().split() or [""]
    return noun in DIVIDED and {"and", "or", "not", "minus"}.isdisjoint(before)


def has_color(phrase: str) -> bool:
    """Whether a phrase names a color."""
    return not COLORS.isdisjoint(phrase.lower().replace("grey", "gray").split())


def is_part(phrase: str) -> bool:
    """Whether a phrase names a part of a thing: the everyday name of the thing, and then another word."""
    *before, last = (_bare(word) for word in phrase.lower().split() or [""])
    return (last in PARTS or last not in NAMES | QUALITIES) and not NAMES.isdisjoint(before)


def thing_of_part(phrase: str) -> str:
    """The thing of which a phrase names a part: "red mug" of "red mug handle"; empty if it names none of `PARTS`."""
    *before, last = phrase.lower().split() or [""]
    if not is_part(phrase) or _bare(last) not in PARTS:
        return ""
    end = max(place for place, word in enumerate(before) if _bare(word) in NAMES)
    return " ".join(before[: end + 1])


def is_part_alone(phrase: str) -> bool:
    """Whether a phrase is one of `PARTS` without its thing, such as "handle" or "wheels"."""
    article, _, noun = phrase.lower().rpartition(" ")
    return article in ("", "a", "an", "the") and _bare(noun) in PARTS


def gives_way(name: str) -> bool:
    """Whether a name gives way to that of a thing that fits: a ring of gold is a ring, a lamp is no shade."""
    return name in MATERIALS or is_part_alone(name)


def part_named(phrase: str) -> str:
    """The last word of a phrase in the singular, as `PARTS` has it: "leaf" of "plant leaves"."""
    return _bare(phrase.lower().split()[-1])


def _bare(word: str) -> str:
    return {"leaves": "leaf", "feet": "foot"}.get(word, word.removesuffix("s"))


def default_vocabulary(clip: str = "") -> list[str]:
    """Everyday things, or the things on which the bundled encoder is trained."""
    return words(_BUNDLED if clip == "bundled" else _EVERYDAY)
