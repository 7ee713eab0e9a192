"""Constants and lists of words by which the page answers as `lexsplat.queries` does."""

from __future__ import annotations

from types import ModuleType
from typing import Any

from lexsplat.queries import (
    clusters,
    everyday,
    part_names,
    parts,
    picking,
    presence,
    selection,
    thresholds,
)
from lexsplat.queries import segments as rule
from lexsplat.queries.vocabulary import COLORS, NAMES, QUALITIES
from lexsplat.scenes.gone import gone_nouns
from lexsplat.scenes.scene import Scene


def segment_rule() -> dict[str, float]:
    """The constants by which the page takes or leaves segments: those of `lexsplat.queries.segments`."""
    cut = constants_of(rule, "LOWEST", "BORDER", "BETTER", "ENOUGH")
    named = constants_of(rule, "OWN_SHARE", "STEEPNESS", "MOST_CERTAIN", "BELOW")
    return {**cut, **named, "threshold": rule.SEGMENT_THRESHOLD}


def part_rule() -> dict[str, float]:
    """The constants by which the page cuts parts of things: those of `lexsplat.queries.parts`."""
    return {
        **constants_of(parts, "HELD", "FEWEST", "NEIGHBORS", "COLOR", "SCORE", "ROUNDS", "SHARED", "BEST"),
        **constants_of(parts, "LOWEST", "MOSTLY", "ALL", "USUAL", "SPREAD"),
        "first": float(parts.PLACES[0]),
        "last": float(parts.PLACES[-1]),
        "steps": len(parts.PLACES),
        **constants_of(parts, "NEAR", "FEW", "WALKED", "NEAREST", "SHORT", "SHORTER", "FIRM", "OUTSIDE"),
    }


def everyday_rule(scene: Scene) -> dict[str, Any]:
    """How the page compares a phrase with everyday words, and what the words of phrases are."""
    return {
        **constants_of(everyday, "BORDER", "STEEPNESS", "OFFSET", "PEAK_SHARE"),
        "peak": scene.everyday_scale.peak,
        **constants_of(presence, "YES", "NO", "YES_SEGMENT", "YES_COLORED", "YES_PART", "NO_SEGMENT"),
        **constants_of(presence, "NO_PART", "AT_THING", "BORDER_PART", "OVER_THING"),
        "names": sorted(NAMES),
        "qualities": sorted(QUALITIES),
        "colors": sorted(COLORS | {"grey"}),
        "parts": list(part_names.NAMES),
        "rival": part_names.RIVAL,
        "alike": part_names.ALIKE,
        "doubtful": part_names.DOUBTFUL,
        "gone": sorted(gone_nouns(scene)),
    }


def selection_rule() -> dict[str, float]:
    """The constants by which the page finds surfaces, instances and evidence: those of `lexsplat.queries`."""
    return {
        "threshold": thresholds.BORDER,
        "link": clusters.LINK,
        **constants_of(selection, "SMALLEST_SHARE", "CONVINCING", "PEAK_COUNT", "FAINT"),
        **constants_of(picking, "SAME_SURFACE", "LEAST_SURFACE"),
        "evidence_share": presence.PEAK_SHARE,
        "evidence_count": presence.PEAK_COUNT,
        "evidence_faint": presence.FAINT,
    }


def constants_of(module: ModuleType, *names: str) -> dict[str, float]:
    """Constants of a module by their names in small letters, as the page reads them."""
    return {name.lower(): getattr(module, name) for name in names}
