"""The tables of the language of the bundled encoder: names, parts, colors, qualities, and words of nothing."""

from __future__ import annotations

from dataclasses import dataclass

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
IN_ITS_COLOR = {"handle", "ears", "leaves", "shade"}
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
NEAR = {frozenset(pair) for pair in (("gold", "yellow"), ("gold", "orange"), ("silver", "gray"), ("silver", "white"),
                                      ("copper", "orange"), ("copper", "brown"), ("gray", "white"),
                                      ("gold", "brown"), ("copper", "gold"), ("copper", "pink"))}  # fmt: skip
"""Colors that a look cannot tell apart with certainty: of each other they are open."""
HUES = {
    "red": 0, "copper": 20, "brown": 25, "orange": 30, "gold": 45, "yellow": 55, "green": 120, "blue": 220,
    "purple": 275, "pink": 340,
}  # fmt: skip
"""Degrees on the color circle; black, white, gray and silver have none."""
NO_ONE_COLOR = {"books", "floor"}
"""Kinds of which color words are open: several colors at once."""


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
