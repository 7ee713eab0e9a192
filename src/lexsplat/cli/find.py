"""``lexsplat find``: things in 3D."""

from __future__ import annotations

import dataclasses

import tyro

from lexsplat.cli.options import Device, check_relevancy, open_scene, print_json


@dataclasses.dataclass
class Find:
    """Find things in 3D: where they are, how large, how many, and whether the scene has them at all.

    Phrases may relate things: "mug on the cloth", "largest book", "fruit but not the banana", "how many apples",
    "chair next to the table" (left of, right of, in front of, behind, on, under, above, below, inside, next to,
    nearest to). Put words into quotation marks inside the phrase to keep them together. Places are in the scene's
    units; sizes are in meters once the scale is known (see `lexsplat scale`).

    Args:
        scene: A scene folder, or ``demo`` for the scene that ships with lexsplat.
        phrases: What to look for.
        view: Whose left and right are meant; none takes the view that shows the other thing best.
        threshold: Relevancy from which a Gaussian belongs to a thing; none chooses one for each.
        clip: Text encoder, if it is not where the build found it.
        device: Where to compute.
        json: Print one JSON document on standard output.
    """

    scene: tyro.conf.Positional[str]
    phrases: tyro.conf.Positional[tuple[str, ...]]
    view: str | None = None
    threshold: float | None = None
    clip: str | None = None
    device: Device = "auto"
    json: bool = False

    def __post_init__(self) -> None:
        check_relevancy(self.threshold)

    def run(self) -> None:
        """Find and print."""
        from lexsplat.scenes.answers import find_phrases

        scene = open_scene(self.scene, self.device, self.clip)
        answers = find_phrases(scene, self.phrases, self.view, self.threshold)
        if self.json:
            print_json(answers)
            return
        for answer in answers["phrases"]:
            count = answer["count"]
            print(f"{answer['phrase']}: present: {answer['present']}, {count} found")
            for number, thing in enumerate(answer["instances"], start=1):
                center = ", ".join(f"{v:.2f}" for v in thing["center"])
                meters = thing.get("size_meters")
                size = " x ".join(f"{v:.2f}" for v in thing["size"])
                if meters is not None:
                    size = " x ".join(f"{v:.3f}" for v in meters) + " m"
                print(f"  {number}. at ({center}), size {size}, score {thing['score']:.2f}, "
                      f"{thing['gaussians']} Gaussians, best seen in {thing['best_view']}")  # fmt: skip
