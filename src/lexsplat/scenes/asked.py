"""The things of a phrase, with how it was understood and how certain the answer is; refused where there are none."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from lexsplat.queries.selection import PRESENCES, Selection
from lexsplat.runtime.errors import QueryError
from lexsplat.scenes.answers import find_best_views
from lexsplat.scenes.scene import Scene
from lexsplat.scenes.serving import shortened


def things_of(scene: Scene, phrase: str) -> tuple[list[Selection], dict[str, Any]]:
    """The instances of a phrase, the best first, and how it was understood, as of `asked_of`.

    Raises:
        QueryError: If the scene does not hold it.
    """
    found, asked = asked_of(scene, phrase)
    return sorted(found.instances, key=lambda one: -one.score), asked


def asked_of(scene: Scene, phrase: str) -> tuple[Selection, dict[str, Any]]:
    """The selection of a phrase, and how the phrase was understood: "understood", "note" and its `certainty`.

    Raises:
        QueryError: If the scene does not hold it.
    """
    understood, found = scene.understand(phrase), scene.find(phrase)
    if found.present == "no" or not found:
        note = f" ({found.note})" if found.note else ""
        raise QueryError(
            phrase[:60],
            expected="something that the scene holds",
            found=f"not here: nothing fits {shortened(str(understood.phrase))}{note}",
        )
    find_best_views(scene, [found])
    return found, {"understood": str(understood.phrase), "note": found.note, **certainty(found)}


def certainty(found: Selection) -> dict[str, Any]:
    """Whether the scene holds something, and where it is seen best, as `Selection.to_dict` has it."""
    return {
        "present": found.present,
        "threshold": round(float(found.threshold), 4),
        "best_view": found.best_view if found and found.present != "no" else "",
    }


def both(first: Mapping[str, Any], second: Mapping[str, Any], link: str, view: str) -> dict[str, Any]:
    """How two phrases were understood; together they are as present as the less certain one.

    Args:
        first: How the first was understood, as of `asked_of`.
        second: How the second was understood.
        link: What stands between them.
        view: The view that shows both best.
    """
    return {
        "understood": f"{first['understood']} {link} {second['understood']}",
        "note": joined(first["note"], second["note"]),
        "present": min(first["present"], second["present"], key=PRESENCES.index),
        "threshold": min(first["threshold"], second["threshold"]),
        "best_view": view,
    }


def joined(*notes: str) -> str:
    """The notes in one line, without repetitions."""
    return "; ".join(dict.fromkeys(filter(None, notes)))
