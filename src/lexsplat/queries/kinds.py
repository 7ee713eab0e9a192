"""Kinds of things: words such as "toy", which are answered by the names of objects.

An encoder describes a teddy bear better with "teddy bear" than with "toy": on the scale of everyday words the name of
a kind loses to the names of its members (`lexsplat.queries.presence`). So a kind holds the objects of a scene whose
names are among its members. Only everyday kinds with everyday members are here; any other word is a plain phrase.
"""

from __future__ import annotations

from dataclasses import replace

from lexsplat.queries.phrases import Phrase, Understood, things_of
from lexsplat.queries.spelling import strange
from lexsplat.queries.vocabulary import PARTS, QUALITIES, SURFACES, default_vocabulary, words

_MEMBERS = {
    "toy": "teddy bear, rubber duck, stuffed animal, doll, ball",
    "animal": "bear, duck, cat, dog, bird",
    "fruit": "apple, banana, orange, lemon, pear",
    "food": "apple, banana, orange, lemon, pear, bread, cake, cookie, cheese, egg, pumpkin",
    "clothes": "shoe, hat, shirt, glove",
    "instrument": "drum, guitar, piano",
    "container": "mug, cup, glass, bottle, bowl, vase, pot, teapot, jar, jug, box, basket, bag, backpack, "
    "bucket, crate, can, pan",
    "tableware": "mug, cup, glass, bottle, bowl, plate, teapot, jug, spoon, fork, knife",
    "electronics": "lamp, phone, camera, laptop, computer, computer keyboard, computer mouse, screen, "
    "headphones, cable",
    "portable": "",
}
_LARGE = """
    tree, bush, chair, sofa, bench, cabinet, bicycle, car, person, statue, piano
"""
"""Everyday things that nobody picks up, in addition to surfaces."""
_SAME = {
    "something to eat": "food", "thing to eat": "food", "edible thing": "food", "pet": "animal",
    "clothing": "clothes", "musical instrument": "instrument", "plaything": "toy", "vessel": "container",
    "receptacle": "container", "crockery": "tableware", "kitchenware": "tableware", "dish": "tableware",
    "device": "electronics", "electronic device": "electronics", "electrical device": "electronics",
    "appliance": "electronics", "electrical appliance": "electronics", "gadget": "electronics",
    "something electronic": "electronics", "something electrical": "electronics",
    "something portable": "portable", "something graspable": "portable",
    **{f"something to {verb}": "portable" for verb in ("pick up", "grasp", "grab", "hold", "lift", "carry")},
}  # fmt: skip
KINDS = {kind: frozenset(words(members)) for kind, members in _MEMBERS.items()}
KINDS["portable"] = (
    frozenset(default_vocabulary() + default_vocabulary("bundled")) - SURFACES - {*words(_LARGE)}
)
KIND_PHRASES = (*_MEMBERS, *_SAME)
"""Every text that names a kind."""
_LONG = 5
"""Letters of a part that a misspelled word may mean, at least: "ear" is too like other words."""
_SHOWN = 40
"""Letters of an unknown word that a note shows, at most."""


def words_of_things(clip: str) -> list[str]:
    """Names of things, their qualities and their kinds: what a misspelled word may mean, for an encoder."""
    parts = (part for part in sorted(PARTS) if len(part) >= _LONG)
    return [*default_vocabulary(clip), *sorted(QUALITIES), *KINDS, *parts]


def is_kind(text: str) -> bool:
    """Whether a text names a kind."""
    return _kind(text) in KINDS


def is_of_kind(name: str, text: str) -> bool:
    """Whether an object's name is a member of the kind that a text names: "toy car" and "striped ball" are toys."""
    kind, parts = _kind(text), name.lower().split()
    return kind in KINDS and (kind in parts or not KINDS[kind].isdisjoint({" ".join(parts), *parts[-1:]}))


def unknown_note(phrase: Phrase, clip: str) -> str:
    """A note on the words of a phrase that an encoder does not know; "" if there are none.

    Args:
        phrase: The phrase.
        clip: Name of the encoder.
    """
    if clip != "bundled":
        return ""
    vocabulary = words_of_things(clip)
    unknown = [word for text in things_of(phrase) for word in strange(text, vocabulary)]
    if not unknown:
        return ""
    listed = ", ".join(f'"{word[:_SHOWN]}"' for word in unknown[:3])
    return f"the bundled encoder knows English words alone, not {listed}"


def with_unknown_words(understood: Understood, clip: str) -> Understood:
    """A parsed phrase with the note of `unknown_note`; it is ``unknown`` if there is one."""
    note = unknown_note(understood.phrase, clip)
    if not note:
        return understood
    return replace(understood, note="; ".join(filter(None, (understood.note, note))), unknown=True)


def _kind(text: str) -> str:
    return _SAME.get(text.lower(), text.lower())
