"""How many natural questions are answered rightly: tests/data/questions.json against a scene.

    python benchmarks/questions.py --scene demo=demo --scene second=output/second [--half tune|kept] [--wrong]

A question names the things that are the right answer (``names``; empty for "no"), things that may be in it as well
(``maybe``), and a ``count`` where one is asked for. Found instances are identified by their place: the nearest thing
of the layout. The questions were written before the grammar. Half of them, drawn with a seed, are kept for the last
measurement: the grammar is not developed on them.
"""

from __future__ import annotations

import json
import math
import random
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from records import argument_parser, write_record

import lexsplat
from lexsplat.runtime.errors import QueryError
from lexsplat.scenes.answers import find_phrases

FILE = Path(__file__).parents[1] / "tests" / "data" / "questions.json"
SEED = 22


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--scene", action="append", default=[], metavar="NAME=FOLDER")
    parser.add_argument("--half", choices=("tune", "kept"), default="tune")
    parser.add_argument("--wrong", action="store_true", help="print the questions that are answered wrongly")
    options = parser.parse_args()
    things = json.loads(FILE.read_text())["things"]
    rows: list[dict[str, Any]] = []
    for name, folder in (item.split("=", 1) for item in options.scene or ["demo=demo"]):
        scene = lexsplat.open_scene(folder)
        asked = [question for question in questions(options.half) if question["scene"] == name]
        right = 0
        for question in asked:
            try:
                answer = find_phrases(scene, question["ask"])["phrases"][0]
            except QueryError as error:
                answer = {"present": "refused", "count": -1, "instances": [], "understood": str(error)}
            held = is_right(question, answer, things[name])
            right += held
            if options.wrong and not held:
                found = sorted(identified(answer["instances"], things[name]))
                print(
                    f"{question['ask']}\n    expected {question.get('names')} {question.get('count', '')}, found "
                    f"{answer['present']} {answer['count']} {found}, understood {answer['understood']}"
                )
        rows.append(
            {
                "scene": name,
                "half": options.half,
                "questions": len(asked),
                "right": right,
                "share": right / len(asked),
            }
        )
    print(json.dumps(rows, indent=1))
    write_record(options.json, rows, half=options.half)


def questions(half: str) -> list[dict[str, Any]]:
    """The questions of one half: "tune" or "kept"."""
    every = json.loads(FILE.read_text())["questions"]
    order = list(range(len(every)))
    random.Random(SEED).shuffle(order)
    middle = len(order) // 2
    return [every[place] for place in sorted(order[:middle] if half == "tune" else order[middle:])]


def is_right(question: Mapping[str, Any], answer: Mapping[str, Any], things: Mapping[str, Any]) -> bool:
    """Whether an answer of ``find --json`` is the expected one."""
    if "count" in question:
        return bool(answer["count"] == question["count"])
    found = identified(answer["instances"], things)
    if not question["names"]:
        return (answer["present"] == "no" and found <= set(question.get("maybe", []))) or (
            bool(found) and found <= set(question.get("maybe", []))
        )
    wanted = set(question["names"])
    return answer["present"] in ("yes", "unsure") and wanted <= found <= wanted | set(
        question.get("maybe", [])
    )


def identified(instances: list[Mapping[str, Any]], things: Mapping[str, Any]) -> set[str]:
    """The names of instances, by the thing of the layout that stands nearest; surfaces by their shape."""
    return {_name(instance["center"], instance["size"], things) for instance in instances}


def _name(center: list[float], size: list[float], things: Mapping[str, Any]) -> str:
    near = min(things, key=lambda name: math.dist(things[name], center[:2]))
    if max(size[:2]) < 1.3:
        return near if math.dist(things[near], center[:2]) < 0.4 else "nothing that has a name"
    if center[1] > 2:
        return "wall"
    if center[2] < -1:
        return "floor"
    return (
        "cloth"
        if size[0] * size[1] < 4.5 and size[2] < 0.5
        else "table"
        if size[2] < 0.6
        else "several things"
    )


if __name__ == "__main__":
    main()
