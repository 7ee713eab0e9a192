"""What a scene keeps on disk so that its first question is fast: what its views show, and the words it compares with.

``checkpoints/seen.safetensors`` is written whole or not at all, after a build and for a saved edit. It names the
Gaussians, segments and cameras that it was computed from. A file of others, or a damaged one, counts as none: what it
holds is then computed when it is asked for. The objects of the scene are beside it (`kept_objects`).
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lexsplat.queries.everyday import everyday_words
from lexsplat.queries.seen import MOST_VIEWS, Seen
from lexsplat.runtime.errors import FileFormatError, LexsplatError
from lexsplat.runtime.files import read_tensors, write_tensors
from lexsplat.runtime.fingerprints import digest
from lexsplat.runtime.progress import Listener
from lexsplat.scenes.folder import SceneFolder
from lexsplat.scenes.kept_objects import FILE, KeptObjects, read_objects, write_objects

if TYPE_CHECKING:
    from lexsplat.features.text import TextTower
    from lexsplat.scenes.scene import Scene

log = logging.getLogger("lexsplat")

_VERSION = 1
"""Raised when the content is computed in another way."""


def seen_of(scene: Scene) -> Seen | None:
    """What the views of a scene show of its segments, from disk where it is kept; None without segments."""
    segments = scene.field.segments
    if segments is None:
        return None
    training = [name for name, view in scene.views.items() if view.split == "train"]
    cameras, kept, key = scene.cameras, None, ""
    path = _path(scene)
    if path is not None and path.exists():
        key = scene_key(scene)
        try:
            tensors, facts = read_tensors(path)
            views = min(len(cameras), MOST_VIEWS)
            fits = tensors["shares"].shape == (segments.levels.shape[1], views)
            if fits and tensors["hidden"].shape == segments.labels.shape and facts.get("of") == key:
                kept = tensors
        except (FileFormatError, KeyError) as error:
            log.warning("%s: computed again (%s)", path, str(error)[:100])
    return Seen(scene.gaussians, cameras, training, segments, kept, key)


def keep(scene: Scene) -> None:
    """Compute what the first questions need, and write it into the folder of the scene, as far as that is possible.

    Args:
        scene: As its folder has it; reports stages "words" and "views".
    """
    path = _path(scene)
    if path is None:
        return
    try:
        if scene.seen is not None and not scene.seen.complete:
            scene.seen.complete_all(scene.listener)
            write_tensors(path, scene.seen.tensors(), {"of": scene_key(scene)})
        words = scene.embed(everyday_words())  # its cache of texts keeps them
        if words.shape[1] != scene.field.codebook.clip.shape[1]:
            return  # no question can be asked with this encoder
        classifier = scene.presence_classifier
        scene.embed(classifier.colored or ["object"])
        if scene.kept is None and scene.field.segments is not None:
            write_objects(scene, KeptObjects(scene.objects, classifier.places), path.with_name(FILE))
    except (OSError, LexsplatError) as error:
        # Nothing is lost: questions compute it, and report a missing encoder.
        log.debug("%s: not kept (%s)", path, str(error)[:200])


def keep_for(
    folder: SceneFolder, device: str, listener: Listener, text_tower: TextTower | None = None
) -> None:
    """`keep` for a finished scene folder.

    Args:
        folder: The scene folder.
        device: Where it is computed.
        listener: Receives the stages "words" and "views".
        text_tower: The encoder of its texts, if it is loaded already.
    """
    from lexsplat.scenes.scene import open_scene

    scene = open_scene(folder.root, device=device)
    scene.listener, scene.text_tower = listener, text_tower
    keep(scene)


def _path(scene: Scene) -> Path | None:
    return None if scene.folder is None else scene.folder.root / "checkpoints" / "seen.safetensors"


def kept_objects_of(scene: Scene) -> KeptObjects | None:
    """The objects of a scene, where its folder keeps them."""
    path = _path(scene)
    return None if path is None else read_objects(scene, path.with_name(FILE))


def scene_key(scene: Scene) -> str:
    """Hash of the Gaussians, segments and cameras of a scene."""
    return digest(_parts(scene))


def _parts(scene: Scene) -> Iterator[bytes]:
    yield f"{_VERSION} {scene.gaussians.antialiased}".encode()
    gaussians, segments = scene.gaussians, scene.field.segments
    tensors = [gaussians.means, gaussians.quats, gaussians.log_scales, gaussians.opacity_logits]
    for tensor in [*tensors, *([segments.labels, segments.masses, segments.levels] if segments else [])]:
        yield np.ascontiguousarray(tensor.detach().cpu().numpy()).tobytes()
    for name, view in scene.views.items():
        yield f"{name}\0{view.split}\0{view.camera.width}x{view.camera.height}".encode()
        yield view.camera.K.tobytes() + view.camera.viewmat.tobytes()
