"""``lexsplat info``: what is in a scene folder."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import tyro

from lexsplat.cli.options import print_json


@dataclasses.dataclass
class Info:
    """Say what is in a scene folder.

    Args:
        scene: A scene folder.
        json: Print one JSON document on standard output.
    """

    scene: tyro.conf.Positional[str]
    json: bool = False

    def run(self) -> None:
        """Print the facts."""
        from lexsplat.scenes.answers import scene_facts
        from lexsplat.scenes.folder import SceneFolder

        facts = scene_facts(SceneFolder.open(Path(self.scene)))
        if self.json:
            print_json(facts)
            return
        width = max(len(name) for name in facts)
        for name, value in facts.items():
            value = "unknown" if value is None else value
            text = ", ".join(f"{k} {v}" for k, v in value.items()) if isinstance(value, dict) else value
            print(f"{name.replace('_', ' '):<{width}}  {text}")
