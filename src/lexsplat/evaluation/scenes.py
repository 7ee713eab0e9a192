"""Measure a scene folder on its held-out views."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lexsplat.captures import Capture, stem_of
from lexsplat.captures.ground_truth.layouts import load_annotations
from lexsplat.captures.ground_truth.prompt_lists import PromptList
from lexsplat.evaluation.ground_truth import GroundTruthSource, read_held_out
from lexsplat.evaluation.measuring import EvaluationConfig, evaluate
from lexsplat.evaluation.protocols import PROTOCOLS
from lexsplat.evaluation.report.gallery import Gallery
from lexsplat.evaluation.report.page import write_report
from lexsplat.evaluation.report.tables import table_rows, write_rows
from lexsplat.evaluation.results import Metrics
from lexsplat.pipeline.inputs import reload_capture
from lexsplat.runtime.environment import machine_facts
from lexsplat.runtime.errors import CaptureError, SceneFolderError
from lexsplat.runtime.files import read_json, require_writable, write_file, write_json
from lexsplat.runtime.fingerprints import file_hash
from lexsplat.runtime.progress import Event, Listener, silent
from lexsplat.scenes.answers import file_name
from lexsplat.scenes.facts import is_of_chosen_views
from lexsplat.scenes.feature_maps import code_colors, feature_picture
from lexsplat.scenes.folder import SceneFolder
from lexsplat.scenes.previous import require_current
from lexsplat.scenes.scene import Scene

log = logging.getLogger("lexsplat")


def evaluate_scene(
    scene: Scene,
    *,
    capture: Path | None = None,
    masks: Path | None = None,
    prompt_list: PromptList | None = None,
    protocols: Sequence[str] = PROTOCOLS,
    title: str = "lexsplat",
    listener: Listener = silent,
) -> dict[str, Any]:
    """Measure a scene on its held-out views.

    Writes metrics.json, metrics.csv, metrics.tex, report.html and heatmaps/ into its folder.

    Args:
        scene: An opened scene folder.
        capture: Folder of the photos, if not where the build found it.
        masks: Folder of the ground truth in any layout of `lexsplat.captures.ground_truth`, if not the capture's own.
        prompt_list: Ask the prompts of the paper or of the released code; for captures named after its scenes.
        protocols: Names out of `lexsplat.evaluation.protocols.PROTOCOLS`.
        title: Heading of the report.
        listener: Receives progress events.

    Returns:
        The content of ``metrics.json``.

    Raises:
        SceneFolderError: If the photos are missing or are others, or the scene is the bundled one or being rebuilt.
        CaptureError: If a photo or a mask cannot be used, or ``masks`` or ``prompt_list`` is given and no held-out
            view has ground truth.
        OSError: If the folder takes no file.
    """
    if scene.folder is None:
        raise ValueError("only a scene opened from a folder can be evaluated")
    folder, record = scene.folder, scene.folder.record
    require_current(folder)
    folder.refuse_bundled()
    require_writable(folder.root)
    photos = reload_capture(folder, capture)
    _refuse_other_photos(folder, photos)
    _warn_of_limits(folder, photos)
    source = GroundTruthSource(masks, prompt_list)
    found = load_annotations(photos) if source == GroundTruthSource() else read_held_out(photos, source)
    gallery = Gallery()
    metrics = evaluate(
        photos,
        scene,
        EvaluationConfig(protocols=tuple(protocols)),
        ground_truth=found,
        prompt_kinds=_prompt_kinds(photos.root),
        observer=gallery.add,
        listener=listener,
    ).with_facts(
        stage_seconds=folder.stage_seconds(),
        stored_bytes={
            "language_bytes": folder.bytes_on_disk(folder.language_path),
            "gaussian_bytes": folder.bytes_on_disk(folder.gaussians_path),
        },
        settings={
            **record.get("config", {}),
            "ground_truth": found.origin_facts(prompt_list) if found.masks else None,
            **_registration(record),
            "warnings": record.get("warnings", []),
        },
        machine=machine_facts(),
    )
    colors = code_colors(scene.field)
    for done, view in enumerate(gallery.views):
        listener(Event("report", done, len(gallery.views)))
        gallery.add_features(view, feature_picture(scene, view, colors).cpu().numpy())
    _write_results(folder.root, metrics, gallery, title)
    listener(Event("report", len(gallery.views), len(gallery.views)))
    return metrics.to_json()


def _refuse_other_photos(folder: SceneFolder, photos: Capture) -> None:
    """Refuse held-out photos that are not those of the build: a folder of another place, or replaced files."""
    built_from = folder.record.get("provenance", {}).get("sources", {})
    other = [
        name
        for name in photos.test_names
        if name in built_from and file_hash(photos.views[name].image_path) != built_from[name]
    ]
    if other:
        raise SceneFolderError(
            photos.root,
            expected="the photos that the scene was built from",
            found=f"{len(other)} of {len(photos.test_names)} held-out photos changed, such as {min(other)}",
            remedy="give their folder with --capture, or build again",
        )


def _warn_of_limits(folder: SceneFolder, photos: Capture) -> None:
    """Warn if there is nothing to measure with, or if the scene is no longer that of the photos."""
    if not photos.test_names:
        way = "build it with --test-every or --test-views"
        if is_of_chosen_views(folder.record):
            way = "views of splats are no ground truth, so give lexsplat language the photos, too"
        log.warning("%s: no held-out views: neither images nor language are measured; %s", folder.root, way)
    if edits := folder.record.get("edits"):
        log.warning(
            "%s: an edited scene is measured beside photos from before its %d edits", folder.root, len(edits)
        )


def _write_results(root: Path, metrics: Metrics, gallery: Gallery, title: str) -> None:
    """Numbers, report and heatmaps of a scene in its folder."""
    result = metrics.to_json()
    write_json(root / "metrics.json", result)
    write_rows(root, "metrics", table_rows({title: result}))
    write_report(root / "report.html", metrics, gallery, title=title)
    for (view, prompt), images in gallery.cases.items():
        path = root / "heatmaps" / file_name(prompt) / f"{stem_of(view)}.jpg"
        write_file(path, images["heatmap"])


def _registration(record: dict[str, Any]) -> dict[str, str]:
    """How many photos structure from motion registered, which not, and by which mapper."""
    note = record["stages"].get("poses", {}).get("note")
    return {"photos": note} if note else {}


def _prompt_kinds(root: Path) -> dict[str, str]:
    """``prompts.json`` of a capture, ``{prompt: kind}``; empty if there is none."""
    path = root / "prompts.json"
    if not path.is_file():
        return {}
    content = read_json(path)
    if not isinstance(content, dict) or not all(isinstance(kind, str) for kind in content.values()):
        raise CaptureError(path, expected="a JSON object {prompt: kind}", found=type(content).__name__)
    return content
