"""Model folders with something wrong in them, and how they are refused."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from lexsplat.features.encoders import load_clip
from lexsplat.runtime.errors import ModelError
from support.refusals import assert_reports

HUGE = int("9" * 400)


def refused(folder: Path, *parts: str, load=load_clip) -> str:
    with pytest.raises(ModelError) as caught:
        load(str(folder))
    assert_reports(caught.value, *parts)
    return str(caught.value)


def change_json(path: Path, change) -> None:
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def with_setting(folder: Path, place: str, value) -> Path:
    """The ``config.json`` of a folder with a setting such as "vision_config.patch_size"; None takes it away."""
    path, (*parts, key) = folder / "config.json", place.split(".")

    def changed(content: dict) -> None:
        for part in parts:
            content = content[part]
        content[key] = value
        if value is None:
            del content[key]

    change_json(path, changed)
    return path
