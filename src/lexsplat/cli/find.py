"""``lexsplat find``: things in 3D."""

from __future__ import annotations

import dataclasses
from typing import Any

from lexsplat.cli.options import (
    Device,
    PhrasesArgument,
    SceneArgument,
    check_phrases,
    check_threshold,
    open_scene,
    print_json,
    print_rests_on,
)


@dataclasses.dataclass
class Find:
    """Find things in 3D: where they are, how large, how many, and whether the scene has them at all.

    Ask in your own words: "mug on the cloth", "what is between the mug and the books?", "largest toy", "two apples",
    "which fruit is closest to me?" (docs/selection.md). What was understood is printed with the answer. Quotation
    marks inside the phrase keep words together. Positions and sizes are in meters once the
    scale is known (see lexsplat scale), and in units of the scene until then; --json has both.

    Args:
        scene: A scene folder, or the word "demo" for the bundled scene.
        phrases: Free-text phrases to find.
        view: Name of the view that left and right refer to.
        threshold: Relevancy from which a Gaussian belongs to a thing.
        clip: Text encoder: a name on the Hugging Face Hub or a folder.
        device: "auto" takes CUDA where there is a GPU.
        json: Print one JSON document on standard output (docs/schemas/find.json).
    """

    scene: SceneArgument
    phrases: PhrasesArgument
    view: str | None = None
    threshold: float | None = None
    clip: str | None = None
    device: Device = "auto"
    json: bool = False

    def check(self) -> None:
        """Refuse invalid options."""
        check_phrases(self.phrases)
        check_threshold(self.threshold)

    def run(self) -> None:
        """Find and print."""
        scene = open_scene(self.scene, self.device, self.clip)
        from lexsplat.scenes.answers import find_phrases

        answers = find_phrases(scene, self.phrases, self.view, self.threshold)
        if self.json:
            print_json(answers)
            return
        for answer in answers["phrases"]:
            _print_answer(answer)
        print_rests_on(scene, answers["rests_on"])


def _print_answer(answer: dict[str, Any]) -> None:
    from lexsplat.queries.places import extent, position
    from lexsplat.scenes.serving import seen_in, shortened, worded

    understood = f" (understood as {worded(answer['understood'])})"
    note = f"; {answer['note']}" if answer["note"] else ""
    phrase = shortened(answer["phrase"], 60)
    print(f"{phrase}: present: {answer['present']}, {answer['count']} found{understood}{note}")
    for number, thing in enumerate(answer["instances"], start=1):
        print(
            f"  {number}. {shortened(thing['name'], 60)} at {position(thing)}, size {extent(thing)}, "
            f"score {thing['score']:.2f}, {thing['gaussians']} Gaussians, {seen_in(thing)}"
        )
