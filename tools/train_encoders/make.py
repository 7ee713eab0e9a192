"""Train the bundled encoders (see README.md)."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
REPOSITORY = HERE.parents[1]
ENCODERS = REPOSITORY / "src" / "lexsplat" / "demo" / "encoders"
sys.path[:0] = [str(HERE), str(REPOSITORY / "tools" / "demo_scene")]

VIEWS = 5
TRAINING_SEED, SEEN_SEED, UNSEEN_SEED = 0, 800_000, 900_000
"""First seeds of the scenes for training, for the scores, and for the scores on pairs that training lacks."""


def render(options: argparse.Namespace) -> None:
    """Render the frames of all random scenes; existing ones are kept."""
    from frames import render_frames  # needs Blender
    from quiet import quiet_output

    say = quiet_output()
    for folder, first, count, samples in (
        ("seen", SEEN_SEED, options.test_scenes, 3),
        ("unseen", UNSEEN_SEED, options.test_scenes, 3),
        ("train", TRAINING_SEED, options.scenes, 2),
    ):
        render_frames(
            options.work / "frames" / folder,
            list(range(first, first + count)),
            views=VIEWS,
            samples=samples,
            threads=options.threads,
            say=say,
        )


def train(options: argparse.Namespace) -> None:
    """Train both encoders; the last line of each log in the work folder has the scores."""
    from clip_settings import PHASES
    from train_clip import train_clip
    from train_dino import DinoTraining, train_dino
    from workers import run_workers

    frames = {name: [options.work / "frames" / name] for name in ("train", "seen", "unseen")}
    for model in options.models:
        folder, log = options.output / model, options.work / f"{model}.jsonl"
        folder.mkdir(parents=True, exist_ok=True)
        if model == "clip":
            for phase in options.phases:
                start = None if phase == "first" else folder
                settings = PHASES[phase]
                run_workers(
                    train_clip, options.threads, *frames.values(), folder, settings, log, phase, start
                )
        else:
            dense = DinoTraining(steps=options.dino_steps)
            run_workers(train_dino, options.threads, frames["train"], frames["seen"], folder, dense, log)


def score(options: argparse.Namespace) -> None:
    """Print the scores of the encoders in the output folder on the held-out frames."""
    from clip_scores import by_pair
    from clip_settings import ClipTraining
    from crops import Frames
    from train_clip import Examination, Trainer
    from train_dino import dense_scores
    from transformers import CLIPTokenizer, ViTModel

    seen, unseen = (Frames([options.work / "frames" / name]) for name in ("seen", "unseen"))
    if "clip" in options.models:
        folder, questions = options.output / "clip", Examination(seen, unseen)
        trainer = Trainer(CLIPTokenizer.from_pretrained(folder), ClipTraining(), folder)
        print(json.dumps(questions.scores(trainer)))
        for pair, (kind, both, count) in by_pair(
            questions.unseen, trainer.encode_images, trainer.encode_text
        ).items():
            print(f"{pair:16s} kind {kind:.2f}  kind and color {both:.2f}  of {count} crops")
    if "dino" in options.models:
        model = ViTModel.from_pretrained(options.output / "dino", add_pooling_layer=False)
        print(json.dumps({name: round(value, 4) for name, value in dense_scores(model, seen).items()}))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--steps", nargs="+", choices=("render", "train", "score"), default=["render", "train"]
    )
    parser.add_argument("--models", nargs="+", choices=("clip", "dino"), default=["clip", "dino"])
    parser.add_argument(
        "--work", type=Path, default=REPOSITORY / "output" / "train_encoders", help="work folder"
    )
    parser.add_argument("--output", type=Path, default=ENCODERS, help="folder that gets clip/ and dino/")
    parser.add_argument("--scenes", type=int, default=292, help="random scenes to train on, five views each")
    parser.add_argument(
        "--test-scenes", type=int, default=20, help="scenes for each of the two sets of scores"
    )
    parser.add_argument(
        "--phases",
        nargs="+",
        choices=("first", "refine", "parts", "dense", "handles", "edges"),
        default=["first", "refine", "parts", "dense"],
        help="of the image-text encoder; all but the first go on from the model in OUTPUT; the first four made the "
        "weights that ship; handles (after parts) and edges (after handles) are experiments "
        "(docs/lab-notes/2026-11-encoders.md), not in them",
    )
    parser.add_argument("--dino-steps", type=int, default=600)
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1)
    options = parser.parse_args()
    options.work.mkdir(parents=True, exist_ok=True)
    if "render" in options.steps and "train" in options.steps:
        # Blender keeps memory and threads for itself: it gets a process of its own, gone before training.
        arguments = [
            argument for argument in sys.argv[1:] if argument not in ("--steps", "render", "train", "score")
        ]
        subprocess.run([sys.executable, __file__, *arguments, "--steps", "render"], check=True)
        train(options)
    elif "render" in options.steps:
        render(options)
    elif "train" in options.steps:
        train(options)
    if "score" in options.steps:
        score(options)


if __name__ == "__main__":
    main()
