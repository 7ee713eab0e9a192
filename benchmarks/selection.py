"""3D selections and presence against exact ground truth.

Ground truth is index maps and depth of each view (``FOLDER/truth/VIEW.npz`` and ``FOLDER/cameras.json``, written by
tools/demo_scene), lifted to Gaussians and boxes (`selection_ground_truth`). The indices of a prompt are derived from
the masks of the capture.

    python benchmarks/selection.py --scene output/demo --ground-truth-of output/demo=RENDERS/tabletop

Prints JSON.
"""

from __future__ import annotations

import json
import random
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from records import argument_parser, write_record
from selection_ground_truth import (
    GroundTruthView,
    box_iou,
    lift_labels,
    selection_f1,
    surface_points,
    true_box,
)

import lexsplat
from lexsplat.geometry.boxes import gravity_up
from lexsplat.geometry.cameras import OPENGL_TO_OPENCV, Camera
from lexsplat.queries.everyday import everyday_words
from lexsplat.queries.vocabulary import NAMES as NOUNS
from lexsplat.queries.vocabulary import STUFF, SURFACES, default_vocabulary
from lexsplat.scenes.objects import objects_of

KINDS = (
    "apple", "rubber duck", "mug", "stack of books", "vase", "ring", "traffic cone", "potted plant", "table lamp",
    "banana", "teddy bear", "striped ball", "bowl", "candle", "green bottle", "pumpkin", "toy car", "wooden crate",
)  # fmt: skip
ALIASES = {  # kinds in things.json: prompts in the lists here
    "duck": "rubber duck", "books": "stack of books", "cone": "traffic cone", "plant": "potted plant",
    "lamp": "table lamp", "teddy": "teddy bear", "ball": "striped ball", "bottle": "green bottle", "car": "toy car",
    "crate": "wooden crate",
}  # fmt: skip
NEVER = (
    "giraffe", "bicycle", "airplane", "computer keyboard", "swimming pool", "guitar", "elephant", "traffic light",
    "bed", "shoe", "pizza", "dog",
)  # fmt: skip
SURFACE_KINDS = ("table", "cloth", "wall", "floor")
MODELED = ("handle", "nose", "belly", "ear", "flame", "wheel", "stalk", "beak", "shade", "cork")
"""Parts that things of tools/demo_scene have, of those that `lexsplat.queries.vocabulary` knows as parts."""
NAMES_ASKED, DRAWS = 300, 10
COLORS = ("red", "green", "blue", "yellow", "white", "brown", "pink", "purple", "orange")


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--scene", type=Path, action="append", default=[])
    parser.add_argument("--ground-truth-of", action="append", default=[], metavar="SCENE=FOLDER")
    parser.add_argument("--stride", type=int, default=1, help="use every n-th view of the ground truth")
    parser.add_argument("--only", choices=("presence", "accuracy", "inventory"), help="measure only this")
    options = parser.parse_args()
    pairs = (item.split("=", 1) for item in options.ground_truth_of)
    ground_truths = {Path(key): Path(value) for key, value in pairs}
    result: dict = {"scenes": {}}
    for folder in dict.fromkeys(options.scene):
        measured = result["scenes"].setdefault(str(folder), {})
        if options.only in (None, "presence"):
            measured["presence"] = presence(folder, ground_truths[folder])
        if options.only in (None, "accuracy"):
            measured["accuracy"] = accuracy(folder, ground_truths[folder], options.stride)
        if options.only in (None, "inventory"):
            measured["inventory"] = inventory(folder, ground_truths[folder], options.stride)
    print(json.dumps(result, indent=1))
    write_record(options.json, table_rows(result), **result)


def table_rows(result: dict) -> list[dict]:
    """The means of each scene, for benchmarks/tables.py."""
    rows = []
    for scene, measured in result["scenes"].items():
        row: dict = {"scene": Path(scene).name, **measured.get("accuracy", {}).get("mean", {})}
        row |= {name: measured["inventory"][name] for name in ("found", "false") if "inventory" in measured}
        for group, found in measured.get("presence", {}).items():
            if isinstance(found, dict):
                row[f"{group}: yes / unsure / no"] = f"{found['yes']} / {found['unsure']} / {found['no']}"
        rows.append(row)
    return rows


def capture_folder(scene: lexsplat.Scene) -> Path:
    """Folder of the photos, prompts and masks of a scene."""
    return Path(scene.folder.record["capture"])


def evidence(folder: Path, ground_truth: Path) -> tuple[dict, dict, dict]:
    """Evidence of prompts that are present, absent, and present in another color."""
    scene = lexsplat.open_scene(folder)
    prompts = list(json.loads((capture_folder(scene) / "prompts.json").read_text()))
    things = list(json.loads((ground_truth / "things.json").read_text()).values())
    kinds = {thing["kind"] for thing in things}
    known = kinds | {ALIASES.get(kind, kind) for kind in kinds}
    absent = [kind for kind in KINDS if kind not in known and kind.split()[-1] not in kinds] + list(NEVER)
    recolored = []
    for number, kind in enumerate(sorted(kinds - set(SURFACE_KINDS))):
        taken = {thing["color"] for thing in things if thing["kind"] == kind}
        free = [color for color in COLORS if color not in taken]
        recolored.append(f"{free[number % len(free)]} {kind}")
    classifier = scene.presence_classifier

    def of(phrases: list[str]) -> dict:
        found = classifier.evidence(phrases, scene.embed(phrases), scene.scores(phrases))
        return dict(zip(phrases, found))

    return of(prompts), of(absent), of(recolored)


def presence(folder: Path, ground_truth: Path) -> dict:
    groups = zip(("present", "absent", "wrong color"), evidence(folder, ground_truth))
    answer = {}
    for name, found in groups:
        decisions = {phrase: e.presence for phrase, e in found.items()}
        answer[name] = {
            "phrases": len(decisions),
            **{word: sum(v == word for v in decisions.values()) for word in ("yes", "unsure", "no")},
            "each": {
                p: [decisions[p], round(e.strength, 3), round(e.ratio, 3), round(e.height, 3)]
                for p, e in found.items()
            },
        }
    present, absent = ([row[1] for row in answer[name]["each"].values()] for name in ("present", "absent"))
    things = json.loads((ground_truth / "things.json").read_text()).values()
    answer["parts"], answer["parts of other things"] = parts(lexsplat.open_scene(folder), list(things))
    limit = float(np.quantile(present, 0.1))
    answer["false positives at 90 % recall"] = round(float(np.mean(np.array(absent) >= limit)), 3)
    return answer


def parts(scene: lexsplat.Scene, things: list[dict]) -> tuple[dict, dict]:
    """Answers to the parts of `MODELED` that the scene's things have, and to those that they lack."""
    has: dict[str, set[str]] = {}
    for thing in things:
        kind = ALIASES.get(thing["kind"], thing["kind"])
        has.setdefault(kind, set()).update(part.removesuffix("s") for part in thing["parts"])
    kinds = [kind for kind in has if kind not in SURFACE_KINDS and kind.split()[-1] in NOUNS]
    asked = [(f"{kind} {part}", part in has[kind]) for kind in kinds for part in MODELED]
    found = dict(zip([phrase for phrase, _ in asked], scene.ask([phrase for phrase, _ in asked]).presences))
    return tuple(
        {
            "phrases": sum(there == wanted for _, there in asked),
            **{
                word: sum(found[phrase] == word for phrase, there in asked if there == wanted)
                for word in ("yes", "unsure", "no")
            },
            "each": {phrase: found[phrase] for phrase, there in asked if there == wanted},
        }
        for wanted in (True, False)
    )


def accuracy(folder: Path, ground_truth: Path, stride: int) -> dict:
    """F1 of Gaussians and IoU of boxes for every prompt whose indices follow from the masks of the capture."""
    scene = lexsplat.open_scene(folder)
    views = load_ground_truth(ground_truth, stride)
    meanings = meaning_of_prompts(capture_folder(scene) / "segmentations", ground_truth)
    lifted = lift_labels(scene.gaussians, views, 256)
    up = gravity_up(scene.cameras.values()).direction
    rows = {}
    for prompt, indices in meanings.items():
        selection = scene.select(prompt)
        wanted = torch.isin(lifted.labels, torch.tensor(indices))
        f1, precision, recall = selection_f1(selection.mask, wanted, lifted.weights)
        rows[prompt] = {"f1": round(f1, 3), "precision": round(precision, 3), "recall": round(recall, 3)}
        boxes = [
            true_box(np.concatenate([surface_points(views, index, stride=3) for index in group]), up)
            for group in things_of(indices)
        ]
        found = [instance.box for instance in selection.instances]
        best = [max((box_iou(box, other) for other in found), default=0.0) for box in boxes]
        rows[prompt] |= {
            "box_iou": round(float(np.mean(best)), 3),
            "instances": len(found),
            "true": len(boxes),
        }
    ideal = best_box_iou(scene, lifted, views, meanings, up)
    names = ("f1", "precision", "recall", "box_iou")
    means = {name: round(float(np.mean([row[name] for row in rows.values()])), 3) for name in names}
    return {"mean": means, "box_iou_of_true_gaussians": ideal, "each": rows}


def inventory(folder: Path, ground_truth: Path, stride: int) -> dict:
    """What `Scene.objects` finds with each of `DRAWS` vocabularies: its things, and its false names.

    The names are the bundled ones and everyday words drawn with a seed, `NAMES_ASKED` together. Rivals such as
    "squash" for a pumpkin are drawn or not.
    """
    scene = lexsplat.open_scene(folder)
    lifted = lift_labels(scene.gaussians, load_ground_truth(ground_truth, stride), 256)
    things = json.loads((ground_truth / "things.json").read_text())
    known = default_vocabulary("bundled")
    others = sorted(set(everyday_words()) - set(known))
    drawn = [random.Random(seed).sample(others, NAMES_ASKED - len(known)) for seed in range(DRAWS)]
    rows = [named_things(objects_of(scene, known + words), things, lifted) for words in drawn]
    found, false = ([row[name] for row in rows] for name in ("found", "false"))
    return {
        "found": f"{min(found)} to {max(found)}, mean {np.mean(found):.1f}, of {rows[0]['things']}",
        "false": f"{min(false)} to {max(false)}, mean {np.mean(false):.1f}",
        "draws": rows,
    }


def named_things(objects, things: dict, lifted) -> dict:
    """Things that objects have under a right name with an IoU of Gaussians of at least .5, and objects that are none.

    A name is right if it ends with the last word of the thing's kind or alias. Gaussians are weighted by what the
    views show of them.
    """
    numbers, best, used = lifted.labels // 10, {}, set()
    for number, thing in things.items():
        wanted, kind = (numbers == int(number)) & (lifted.labels > 0), thing["kind"]
        right = {ALIASES.get(kind, kind).split()[-1].removesuffix("s"), kind.removesuffix("s")}
        if kind == "cloth":
            right.add("tablecloth")
        ious = [
            (iou_of(each.mask, wanted, lifted.weights), place)
            for place, each in enumerate(objects)
            if each.phrase.split()[-1].removesuffix("s") in right
        ]
        iou, place = max(ious, default=(0.0, -1))
        best[f"{thing['color']} {kind}"] = round(iou, 3)
        used |= {place} if iou >= 0.5 else set()
    wanted = {name: iou for name, iou in best.items() if name.split()[-1] not in SURFACE_KINDS}
    false = [
        each.phrase
        for place, each in enumerate(objects)
        if place not in used and each.phrase not in SURFACES | STUFF
    ]
    found = sum(iou >= 0.5 for iou in wanted.values())
    return {"found": found, "things": len(wanted), "false": len(false), "false names": false, "IoU": best}


def iou_of(mask, wanted, weights) -> float:
    """Intersection over union of two sets of Gaussians, weighted."""
    mask = mask.cpu()
    return float(weights[mask & wanted].sum() / weights[mask | wanted].sum().clamp_min(1e-12))


def best_box_iou(scene, lifted, views, meanings, up) -> float:
    """IoU of boxes around the correct Gaussians: the upper bound set by the reconstruction."""
    from lexsplat.queries.selection import Selection

    found = []
    for indices in meanings.values():
        for group in things_of(indices):
            mask = torch.isin(lifted.labels, torch.tensor(group)) & (lifted.purity > 0.5)
            if not mask.any():
                continue
            chosen = Selection(scene.gaussians, scene.cameras, mask, mask.float()).largest()
            exact = np.concatenate([surface_points(views, index, stride=3) for index in group])
            found.append(box_iou(chosen.box, true_box(exact, up)))
    return round(float(np.mean(found)), 3)


def things_of(indices: list[int]) -> list[list[int]]:
    """Indices grouped by thing; an index is 10 times the thing plus the part."""
    return [[i for i in indices if i // 10 == thing] for thing in sorted({i // 10 for i in indices})]


def load_ground_truth(folder: Path, stride: int) -> list[GroundTruthView]:
    record = json.loads((folder / "cameras.json").read_text())
    views = []
    for name in sorted(record["camera_to_world"])[::stride]:
        pose = np.array(record["camera_to_world"][name], float)
        viewmat = np.linalg.inv(pose @ OPENGL_TO_OPENCV)
        camera = Camera(record["width"], record["height"], np.array(record["K"], float), viewmat)
        with np.load(folder / "truth" / f"{name}.npz", allow_pickle=False) as content:
            views.append(GroundTruthView(camera, content["index"], content["depth"].astype(np.float64)))
    return views


def meaning_of_prompts(masks: Path, ground_truth: Path) -> dict[str, list[int]]:
    """Indices that lie mostly inside the masks of a prompt, over all views with masks."""
    inside: dict[str, np.ndarray] = {}
    total: dict[str, np.ndarray] = {}
    for path in sorted(masks.glob("*/*.png")):
        with np.load(ground_truth / "truth" / f"{path.parent.name}.npz", allow_pickle=False) as content:
            index = content["index"]
        size = (index.shape[1], index.shape[0])
        mask = np.array(Image.open(path).convert("L").resize(size, Image.Resampling.NEAREST)) > 127
        prompt = path.stem.replace("_", " ")
        inside.setdefault(prompt, np.zeros(256))
        total.setdefault(prompt, np.zeros(256))
        inside[prompt] += np.bincount(index[mask], minlength=256)
        total[prompt] += np.bincount(index.ravel(), minlength=256)
    meant = {p: np.flatnonzero(inside[p] > 0.5 * np.maximum(total[p], 1)).tolist() for p in inside}
    return {prompt: indices for prompt, indices in meant.items() if indices}


if __name__ == "__main__":
    main()
