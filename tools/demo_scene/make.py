"""Generate the demo scenes (see README.md)."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from layouts import BUNDLED, LAYOUTS
from quiet import quiet_output

REPOSITORY = Path(__file__).resolve().parents[2]
CAPTURES = REPOSITORY / "src" / "lexsplat" / "demo" / "captures"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="+", choices=LAYOUTS, default=list(BUNDLED))
    parser.add_argument("--steps", nargs="+", choices=("render", "pack"), default=["render", "pack"])
    parser.add_argument("--work", type=Path, default=REPOSITORY / "output" / "demo_scene", help="work folder")
    parser.add_argument("--output", type=Path, default=CAPTURES, help="folder that gets one folder a scene")
    parser.add_argument("--samples", type=int, default=16, help="paths a pixel at most")
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1)
    parser.add_argument(
        "--every", type=int, default=1, help="render only every so many views, to have a look"
    )
    parser.add_argument(
        "--truth", action="store_true", help="also write OUTPUT/SCENE/truth: depths and indices of all views"
    )
    parser.add_argument(
        "--without",
        metavar="KIND",
        help="only render the held-out views without a thing, to WORK/SCENE-without-KIND",
    )
    options = parser.parse_args()
    say = quiet_output()
    for name in options.scenes:
        layout, work = LAYOUTS[name], options.work / name
        if options.without:
            kinds = {place.kind for place in layout.placements}
            if options.without not in kinds:
                parser.error(f"{name} has no {options.without!r}; it has {', '.join(sorted(kinds))}")
            options.steps, work = ["render"], options.work / f"{name}-without-{options.without}"
        if "render" in options.steps:
            from render import render  # needs Blender

            render(
                layout,
                work,
                samples=options.samples,
                threads=options.threads,
                say=say,
                every=options.every,
                without=options.without,
            )
        if "pack" in options.steps:
            from pack import pack  # needs pycolmap and Pillow

            pack(layout, work, options.output / name, truth=options.truth, say=say)
    sys.stdout.flush()


if __name__ == "__main__":
    main()
