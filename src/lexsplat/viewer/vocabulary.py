"""The phrases that "What is this?" chooses from, and suggestions while the user types."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

MAX_PHRASES = 500
MAX_LENGTH = 120
"""Characters in one phrase."""


def clean_phrases(phrases: Iterable[str]) -> list[str]:
    """Normalize white space; drop empty phrases and duplicates (ignoring case); keep at most `MAX_PHRASES`."""
    cleaned: dict[str, str] = {}
    for phrase in phrases:
        short = " ".join(phrase.split())[:MAX_LENGTH].strip()
        if short:
            cleaned.setdefault(short.lower(), short)
        if len(cleaned) == MAX_PHRASES:
            break
    return list(cleaned.values())


def suggestions(typed: str, history: Sequence[str], vocabulary: Sequence[str], count: int = 6) -> list[str]:
    """Complete what the user typed, from the history first and then from the vocabulary.

    Phrases that start with the typed text come before phrases with a later word that starts with it. Empty text
    returns the latest prompts.

    Args:
        typed: The text so far.
        history: Earlier prompts, latest first.
        vocabulary: Further phrases.
        count: Maximum number of suggestions.
    """
    start = " ".join(typed.lower().split())
    if not start:
        return clean_phrases(history)[:count]
    pool = [phrase for phrase in clean_phrases([*history, *vocabulary]) if phrase.lower() != start]
    begins = [phrase for phrase in pool if phrase.lower().startswith(start)]
    within = [p for p in pool if p not in begins and any(w.startswith(start) for w in p.lower().split())]
    return (begins + within)[:count]
