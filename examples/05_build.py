"""Build a scene from Python, and search it.

    python examples/05_build.py [CAPTURE [OUTPUT [ITERATIONS]]]

CAPTURE is a folder of photos with cameras (see docs/captures.md). Without it, the small bundled capture is built
coarsely, which takes about a minute on two cores. Run it again to continue after an interruption.
"""

import sys
from dataclasses import replace
from pathlib import Path

import lexsplat
from lexsplat import build
from lexsplat.evaluation.demo import DEMO_CONFIG, demo_capture
from lexsplat.runtime.progress import Event

words = sys.argv[1:]
capture = Path(words[0]) if words else demo_capture("second")
output = Path(words[1] if len(words) > 1 else "output/examples/scene")
iterations = int(words[2]) if len(words) > 2 else 300  # a good scene needs thousands


def show(event: Event) -> None:
    """Print the end of each stage; `event.metrics` has numbers such as PSNR."""
    if event.done == event.total:
        print(f"{event.stage}: {event.done} of {event.total}")


# The bundled encoders know only scenes like the demo. For photos of your own, use BuildConfig(): it loads real CLIP.
settings = replace(DEMO_CONFIG, iterations=iterations)
build(capture, output, settings, listener=show)

scene = lexsplat.open_scene(output)
for phrase in ("green apple", "blue ball"):
    found = scene.select(phrase)
    print(f"{phrase}: present: {found.present}, {len(found)} of {len(scene.gaussians)} Gaussians")
