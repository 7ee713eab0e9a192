"""``lexsplat ask``: many questions to one scene, from one process."""

from __future__ import annotations

import dataclasses
import sys
from typing import Annotated, ClassVar

import tyro

from lexsplat.cli.options import Device, SceneArgument, note_hidden_demo, note_version
from lexsplat.cli.waiting import LateProgress, starting

Phrases = tyro.conf.Positional[Annotated[tuple[str, ...], tyro.conf.arg(metavar="PHRASE ...")]]


@dataclasses.dataclass
class Ask:
    """Ask a scene in your own words: "where is the mug?", "what is on the table?", "how many toys are there?".

    With --stdin the scene stays open. Each line of standard input is a phrase, or a JSON object with "ask" and
    optionally "view", "threshold" and "id". Each line of standard output is the answer as one JSON document. Errors
    are answers as well, and the program goes on.

    Args:
        scene: A scene folder, or the word "demo" for the bundled scene.
        phrases: Phrases to ask, if they do not come from standard input.
        stdin: Answer the lines of standard input until it ends.
        clip: Text encoder: a name on the Hugging Face Hub or a folder.
        device: "auto" takes CUDA where there is a GPU.
    """

    scene: SceneArgument
    phrases: Phrases = ()
    stdin: bool = False
    clip: str | None = None
    device: Device = "auto"

    defaults: ClassVar[dict[str, str]] = {"clip": "the encoder of the build"}

    def check(self) -> None:
        """Refuse invalid options."""
        if bool(self.phrases) == self.stdin:
            raise ValueError('give either phrases, such as "where is the mug?", or --stdin')

    def run(self) -> None:
        """Answer."""
        with starting():
            from lexsplat.scenes.answers import find_phrase
            from lexsplat.scenes.serving import OpenScene, answer_line, json_line, lines_of, sentence

        note_hidden_demo(self.scene)
        # Where a terminal has other letters, "\\u1f34e" stands for an apple; lone surrogates stay valid JSON.
        sys.stdout.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
        served = OpenScene(self.scene, self.device, self.clip, LateProgress())
        if served.scene.folder is not None:
            note_version(served.scene.folder, self.scene)
        for phrase in self.phrases:
            print(sentence(find_phrase(served.scene, phrase)))
        if not self.stdin:
            return
        served.warm()
        print(f"{self.scene}: ready, one question a line", file=sys.stderr, flush=True)
        sys.stdin.reconfigure(encoding="utf-8", errors="replace")  # type: ignore[union-attr]
        sys.stdout.reconfigure(encoding="utf-8", errors="backslashreplace")  # type: ignore[union-attr]
        for line in lines_of(sys.stdin):
            if line.strip():
                print(json_line(answer_line(served, line)), flush=True)
