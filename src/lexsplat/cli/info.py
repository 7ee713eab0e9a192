"""``lexsplat info``: what a scene folder contains."""

from __future__ import annotations

import dataclasses

from lexsplat.cli.options import SceneArgument, open_folder, print_json
from lexsplat.cli.waiting import starting


@dataclasses.dataclass
class Info:
    """Show what a scene folder contains.

    Args:
        scene: A scene folder, or the word "demo" for the bundled scene.
        json: Print one JSON document on standard output (docs/schemas/info.json).
    """

    scene: SceneArgument
    json: bool = False

    def run(self) -> None:
        """Print the facts."""
        with starting():
            from lexsplat.scenes.facts import NO_SEGMENTS, scene_facts
            from lexsplat.scenes.previous import REBUILD
            from lexsplat.scenes.unsaved import discarding, saving

        facts = scene_facts(open_folder(self.scene, shows_steps=True))
        if self.json:
            print_json(facts)
            return
        if facts["method"] is not None and facts["segments"] is None:
            facts["segments"] = f"none: {NO_SEGMENTS}"
        if edits := facts.pop("edits"):
            facts["edits"] = "; ".join(edits)
        if count := facts.pop("unsaved_steps"):
            facts["unsaved_steps"] = f"{count:,}; {saving(self.scene, count)}"
        if count := facts.pop("outdated_steps"):
            facts["outdated_steps"] = f"{count:,}, which {discarding(self.scene, count)}"
        if facts.pop("rebuilding"):
            facts["rebuild"] = f"{REBUILD}; these are facts of the scene before it"
        chosen = facts.pop("chosen_views")
        if chosen is not None:
            facts["capture"] = (
                f"none: {chosen['views']} views chosen from {chosen['splats']}; "
                f"{chosen['unseen']:,} of {chosen['visible']:,} visible Gaussians are in none of them, "
                f"{chosen['floaters']:,} floaters left out"
            )
        width = max(len(name) for name in facts)
        for name, value in facts.items():
            value = "unknown" if value is None else value
            text = ", ".join(f"{k} {v}" for k, v in value.items()) if isinstance(value, dict) else value
            print(f"{name.replace('_', ' '):<{width}}  {text}")
