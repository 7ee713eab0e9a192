"""What the commands ``query``, ``evaluate`` and ``info`` answer: plain data for JSON, pictures for people."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from lexsplat.geometry.world import world_of
from lexsplat.queries.heatmaps import overlay_heatmap
from lexsplat.queries.phrases import parse
from lexsplat.queries.relevancy import check_prompts
from lexsplat.runtime.files import atomic_path
from lexsplat.scenes.folder import SceneFolder
from lexsplat.scenes.scene import Scene

MAX_DEFAULT_VIEWS = 6
"""How many held-out views a query without ``--view`` draws."""


def answer_queries(
    scene: Scene,
    prompts: Sequence[str],
    views: Sequence[str],
    threshold: float | None,
    folder: Path | None,
) -> dict[str, Any]:
    """Answer prompts in views, and write a heatmap and a mask for each pair.

    Args:
        scene: The scene to ask.
        prompts: What to look for.
        views: Names of views; none means up to `MAX_DEFAULT_VIEWS` held-out views.
        threshold: Relevancy from which a pixel belongs to a mask; none chooses one for each prompt.
        folder: Where ``PROMPT/VIEW.png`` and ``PROMPT/VIEW.mask.png`` go; none writes no images.

    Returns:
        ``{"scene", "form", "prompts": [...]}``; a prompt has "threshold", "peak", "best_view", "gaussians",
        "present" ("yes", "no" or "unsure": is it in the scene at all?) and "views".

    Raises:
        QueryError: If a prompt is empty or a view is unknown.
    """
    prompts = check_prompts(prompts)
    names = [scene.view(name).name for name in views] or _default_views(scene)
    if threshold is None:
        thresholds = scene.thresholds(prompts).tolist()
    else:
        thresholds = [float(threshold)] * len(prompts)
    scores = scene.scores(prompts)
    answers: list[dict[str, Any]] = [
        {
            "prompt": prompt,
            "threshold": round(limit, 4),
            "peak": 0.0,
            "best_view": names[0],
            "gaussians": int((score >= limit).sum()),
            "present": scene.presence_classifier.judge(score),
            "views": {},
        }
        for prompt, limit, score in zip(prompts, thresholds, scores)
    ]
    for name in names:
        picture = _to_uint8(scene.render(name).image)
        relevancy = scene.relevancy(prompts, name).cpu().numpy()
        for answer, limit, values in zip(answers, thresholds, relevancy):
            answer["views"][name] = _write_pictures(folder, answer["prompt"], name, picture, values, limit)
            if values.max() > answer["peak"]:
                answer["peak"], answer["best_view"] = float(values.max()), name
    return {
        "scene": str(scene.folder.root) if scene.folder else None,
        "form": scene.query.form,
        "prompts": answers,
    }


def find_phrases(
    scene: Scene,
    phrases: Sequence[str],
    view: str | None = None,
    threshold: float | None = None,
) -> dict[str, Any]:
    """What ``lexsplat find`` says: the things that phrases ask for, in 3D.

    Args:
        scene: The scene to ask.
        phrases: What to look for, with relations (`lexsplat.queries.phrases`).
        view: Name of the view whose left and right are meant; none takes one for each relation.
        threshold: Relevancy from which a Gaussian belongs to a thing; none chooses one for each.

    Returns:
        ``{"scene", "up", "meters_per_unit", "phrases": [...]}``; a phrase has "phrase", "understood", "present",
        "count", "threshold", "best_view" and "instances" with center, size and axes in world units, and
        "size_meters" where the scale is known.

    Raises:
        QueryError: If a phrase is empty or the view is unknown.
    """
    answers = []
    for phrase in check_prompts(phrases):
        found = scene.find(phrase, view, threshold=threshold)
        entry = found.to_json()
        known = {"phrase": phrase, "understood": str(parse(phrase)), "count": len(entry["instances"])}
        answers.append({**entry, **known})
    return {
        "scene": str(scene.folder.root) if scene.folder else None,
        **scene.world.to_json(),
        "phrases": answers,
    }


def _default_views(scene: Scene) -> list[str]:
    held_out = [name for name, view in scene.views.items() if view.split == "test"]
    names = held_out or list(scene.views)
    return names[:: max(1, len(names) // MAX_DEFAULT_VIEWS)][:MAX_DEFAULT_VIEWS]


def _write_pictures(
    folder: Path | None, prompt: str, name: str, picture: np.ndarray, relevancy: np.ndarray, threshold: float
) -> dict[str, Any]:
    mask = relevancy >= threshold
    row, column = np.unravel_index(int(relevancy.argmax()), relevancy.shape)
    answer: dict[str, Any] = {
        "peak": round(float(relevancy.max()), 4),
        "peak_pixel": [int(column), int(row)],
        "mask_share": round(float(mask.mean()), 5),
    }
    if folder is None:
        return answer
    stem = folder / file_name(prompt) / Path(name).with_suffix("")
    heatmap_path = stem.with_name(stem.name + ".png")
    mask_path = stem.with_name(stem.name + ".mask.png")
    for path, pixels in (
        (heatmap_path, overlay_heatmap(picture, relevancy)),
        (mask_path, mask.astype(np.uint8) * 255),
    ):
        with atomic_path(path) as temporary:
            Image.fromarray(pixels).save(temporary, format="PNG")
    return {**answer, "heatmap": str(heatmap_path), "mask": str(mask_path)}


def file_name(prompt: str) -> str:
    """A file name for a prompt: its letters and digits, in any alphabet, joined by underscores."""
    return re.sub(r"\W+", "_", prompt.lower()).strip("_")[:80] or "prompt"


def _to_uint8(image: torch.Tensor) -> np.ndarray:
    return (image.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()


def scene_facts(folder: SceneFolder) -> dict[str, Any]:
    """What ``lexsplat info`` says about a scene folder."""
    record = folder.record
    views = folder.read_cameras()
    splits = [view.split for view in views.values()]
    sizes = sorted({f"{view.camera.width}x{view.camera.height}" for view in views.values()})
    config = record.get("config", {})
    stages = record["stages"]
    averaged = stages.get("language", {}).get("method") == "averaged"
    codes = stages.get("language" if averaged else "codebook", {})  # where they were found
    facts: dict[str, Any] = {
        "scene": str(folder.root),
        "capture": record.get("capture"),
        "views": {"training": splits.count("train"), "held out": splits.count("test")},
        "size": ", ".join(sizes),
        **world_of(record, {name: view.camera for name, view in views.items()}).to_json(),
        "finished": ", ".join(stages) or "nothing yet",
        "seconds": folder.stage_seconds(),
        "gaussians": stages.get("reconstruct", {}).get("gaussians"),
        "codes": codes.get("codes"),
        "codes_used": codes.get("codes_used"),
        "method": stages.get("language", {}).get("method"),
        **({} if averaged else {"weight_dropped": stages.get("language", {}).get("dropped")}),
        "clip": config.get("clip"),
        "dino": "not used" if averaged else config.get("dino"),
        "gaussian_bytes": folder.bytes_on_disk(folder.gaussians_path),
        "language_bytes": folder.bytes_on_disk(folder.language_path),
        "code_map_bytes": folder.bytes_on_disk(folder.root / "codes"),
        "warnings": len(record.get("warnings", [])),
        "lexsplat": record.get("provenance", {}).get("lexsplat"),
    }
    return facts
