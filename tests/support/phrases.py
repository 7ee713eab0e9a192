"""Phrases as the grammar reads them."""

from __future__ import annotations

from lexsplat.queries.grammar import understand
from lexsplat.queries.phrases import Phrase


def parse(text: str) -> Phrase:
    """The phrase that a text is understood as."""
    return understand(text).phrase
