"""How often things that touch are counted apart, and things that are one are divided.

    python benchmarks/touching.py --scene demo [--scene output/second] [--json FILE]

Each object of a scene is copied, turned about the vertical and moved towards itself from a random side until the two
touch; a third one follows for a row of three. What everyday words and clicks select counts as one thing each, because
the objects of the bundled scenes stand apart. Prints JSON.
"""

from __future__ import annotations

import json
from collections import Counter

import numpy as np
from records import argument_parser, write_record
from scipy.spatial import cKDTree

import lexsplat
from lexsplat.geometry.boxes import upright_frame
from lexsplat.queries.clusters import clusters, spacing
from lexsplat.queries.everyday import everyday_words
from lexsplat.queries.selection import FAINT, Selection
from lexsplat.queries.touching import divided
from lexsplat.queries.vocabulary import SURFACES
from lexsplat.runtime.errors import QueryError

PAIRS, CLICKS = 6, 12
TOUCHING = 0.004
"""Share of the points of a copy that lie within a spacing of the original."""
UP = np.array([0.0, 0.0, 1.0])


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--scene", action="append", default=[])
    options = parser.parse_args()
    rows = [measured(path) for path in options.scene or ["demo"]]
    print(json.dumps(rows, indent=1))
    write_record(options.json, rows)


def measured(path: str) -> dict:
    """One scene: how many pairs and rows of each object are counted rightly, and what else is divided."""
    scene, random = lexsplat.open_scene(path), np.random.default_rng(1)
    right: dict[str, Counter] = {"two": Counter(), "three": Counter()}
    for thing in scene.objects:
        if thing.phrase in SURFACES:
            continue
        points = upright(thing)
        for number in range(PAIRS):
            side = random.uniform(0, 2 * np.pi)
            pair = np.concatenate([points, beside(points, points, side, random)])
            right["two"][thing.phrase] += counted(pair) == 2
            if number < 2:
                third = beside(pair[len(points) :], points, side + 0.3, random)
                right["three"][thing.phrase] += counted(np.concatenate([pair, third])) == 3
    ones = [*selected(scene), *clicked(scene, random)]
    wrong = [name for name, points in ones if counted(points) > 1]
    return {"scene": path, **right, "one thing": len(ones), "divided": wrong}


def upright(thing: Selection) -> np.ndarray:
    """The firm points of a thing, with z up."""
    points, opacities = thing.points
    return points[opacities >= FAINT] @ np.stack(upright_frame(thing.up.direction)).T


def counted(points: np.ndarray) -> int:
    """The largest connected cluster of the points, and how many things it counts as."""
    firm = np.ones(len(points), bool)
    labels = clusters(points, firm)
    largest = points[labels == np.bincount(labels).argmax()]
    one = np.zeros(len(largest), np.intp)
    return int(divided(largest, firm[: len(largest)], one, UP).max()) + 1


def beside(points: np.ndarray, copied: np.ndarray, side: float, random: np.random.Generator) -> np.ndarray:
    """A copy, turned about the vertical, that touches ``points`` from one side."""
    turn = random.uniform(0, 2 * np.pi)
    rotation = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    copy = (copied - copied.mean(0)) @ rotation.T + points.mean(0)
    way, tree, reach = np.array([np.cos(side), np.sin(side), 0]), cKDTree(points), spacing(points)
    low, high = 0.0, 10 * float(np.ptp(points, axis=0).max())
    for _ in range(25):
        middle = (low + high) / 2
        apart = np.quantile(tree.query(copy + middle * way)[0], TOUCHING) > reach
        low, high = (low, middle) if apart else (middle, high)
    return copy + high * way


def selected(scene: lexsplat.Scene) -> list[tuple[str, np.ndarray]]:
    """What everyday words select, each set of Gaussians once."""
    found = {}
    for word in everyday_words():
        chosen = scene.ask(word).selection(0)
        found.setdefault(chosen.mask.numpy().tobytes(), (word, chosen))
    return [(word, upright(chosen)) for word, chosen in found.values() if len(chosen) > 1]


def clicked(scene: lexsplat.Scene, random: np.random.Generator) -> list[tuple[str, np.ndarray]]:
    """What clicks at random pixels of every fourth view select."""
    found = []
    for name in list(scene.views)[::4]:
        camera = scene.view(name).camera
        for x, y in random.uniform(0, (camera.width, camera.height), (CLICKS, 2)):
            try:
                found.append((f"{name} at {x:.0f}, {y:.0f}", upright(scene.click(name, x, y))))
            except QueryError:  # nothing there
                continue
    return found


if __name__ == "__main__":
    main()
