"""Validated requests of pages: a question about a place, and an action."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lexsplat.geometry.cameras import Camera
from lexsplat.queries.thresholds import check_threshold
from lexsplat.runtime.errors import QueryError
from lexsplat.viewer.history import MAX_LENGTH

MOST_PIXELS = 16_384
"""Width and height of a page, at most."""


ASKED = ("prompt", "camera", "click", "threshold", "instance")
"""Keys of `Asked.from_json`."""


@dataclass(frozen=True)
class Asked:
    """Subject of a request: a phrase, or the thing at a pixel.

    Args:
        prompt: The phrase; "" for a click.
        camera: The camera of the page, which defines left and right; None takes one of the views.
        click: The pixel that was clicked, from the left and from the top.
        threshold: Smallest score of a selected Gaussian; None takes the automatic one.
        instance: Number of the only instance that is meant, from 0; None means all.
    """

    prompt: str = ""
    camera: Camera | None = None
    click: tuple[float, float] | None = None
    threshold: float | None = None
    instance: int | None = None

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Asked:
        """Read a question.

        Raises:
            QueryError: If it is none.
        """
        prompt, click, threshold = data.get("prompt") or "", data.get("click"), data.get("threshold")
        if not isinstance(prompt, str) or len(prompt) > MAX_LENGTH:
            found = f"{len(prompt)} characters" if isinstance(prompt, str) else type(prompt).__name__
            raise QueryError("prompt", expected=f"a text of at most {MAX_LENGTH} characters", found=found)
        camera = None if data.get("camera") is None else _camera(data["camera"])
        if click is not None and camera is None:
            raise QueryError("click", expected="a camera with it", found="none")
        instance = data.get("instance")
        if instance is not None and (type(instance) is not int or instance < 0):
            raise QueryError("instance", expected="a number from 0", found=repr(instance)[:40])
        pixel = None if click is None else _numbers("click", click, 2)
        return cls(
            prompt.strip(),
            camera,
            None if pixel is None else (pixel[0], pixel[1]),
            None if threshold is None else check_threshold(threshold),
            instance,
        )


def read_document(body: bytes) -> dict[str, Any]:
    """The JSON object of a request.

    Raises:
        QueryError: If it is none.
    """
    try:
        found = json.loads(body)
    except (ValueError, RecursionError) as error:
        raise QueryError("request", expected="a JSON object", found=str(error)[:80]) from error
    if not isinstance(found, dict):
        raise QueryError("request", expected="a JSON object", found=type(found).__name__)
    return found


def refuse_unknown(data: Mapping[str, Any], known: Sequence[str]) -> None:
    """Refuse a request with keys that nothing reads, which are misspelled as a rule.

    Raises:
        QueryError: If there is one.
    """
    if unknown := sorted(set(data) - set(known)):
        raise QueryError("request", expected=f"keys out of {', '.join(known)}", found=repr(unknown[0])[:40])


def number(data: Mapping[str, Any], name: str, default: float) -> float:
    """A finite number of a request.

    Raises:
        QueryError: If it is none.
    """
    return _numbers(name, [data.get(name, default)], 1)[0]


def vector(data: Mapping[str, Any], name: str) -> list[float]:
    """Three finite numbers of a request; zeros if they are not given.

    Raises:
        QueryError: If they are none.
    """
    return _numbers(name, data.get(name, [0, 0, 0]), 3)


def _camera(data: Any) -> Camera:
    if not isinstance(data, Mapping):
        raise QueryError("camera", expected="an object", found=type(data).__name__)
    viewmat = np.array(_numbers("viewmat", data.get("viewmat"), 16)).reshape(4, 4)
    width, height, focal, x, y = _numbers("lens", data.get("lens"), 5)
    if not (1 <= width <= MOST_PIXELS and 1 <= height <= MOST_PIXELS and focal > 0):
        raise QueryError("lens", expected=f"1 to {MOST_PIXELS} pixels and a focal length", found=f"{width:g}")
    K = np.array([[focal, 0, x], [0, focal, y], [0, 0, 1]])
    try:
        return Camera(int(width), int(height), K, viewmat)
    except ValueError as error:
        raise QueryError("viewmat", expected="a rotation and a translation", found=str(error)) from error


def _numbers(name: str, values: Any, count: int) -> list[float]:
    good = isinstance(values, list) and len(values) == count
    if not good or not all(type(v) in (int, float) and math.isfinite(v) and abs(v) < 1e9 for v in values):
        raise QueryError(name, expected=f"{count} numbers", found=repr(values)[:40])
    return [float(value) for value in values]
