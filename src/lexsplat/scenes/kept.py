"""Results that a scene keeps on disk to make its first questions fast: visibility of segments, words, objects.

``checkpoints/seen.safetensors`` names the Gaussians, segments and cameras that it was computed from, and
``checkpoints/objects.safetensors`` also the encoder, vocabularies and query. Both are written whole or not at all,
after a build and for a saved edit. A file of another scene, or a damaged one, counts as none: what it holds is then
computed when it is asked for. Dimension letters: N Gaussians, O objects, V places, K codes.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from lexsplat.geometry.boxes import Box
from lexsplat.queries.everyday import everyday_words
from lexsplat.queries.part_names import NAMES as PART_NAMES
from lexsplat.queries.presence import DescribedPlaces
from lexsplat.queries.seen import MOST_VIEWS, Seen
from lexsplat.queries.selection import Selection
from lexsplat.queries.vocabulary import DIVIDED, STUFF, SURFACES, default_vocabulary
from lexsplat.runtime.errors import FileFormatError, LexsplatError
from lexsplat.runtime.files import read_tensors, write_tensors
from lexsplat.runtime.fingerprints import digest
from lexsplat.runtime.progress import NOTE, Listener
from lexsplat.scenes.folder import SceneFolder

if TYPE_CHECKING:
    from lexsplat.features.text import TextTower
    from lexsplat.scenes.scene import Scene

log = logging.getLogger("lexsplat")

_SEEN_VERSION, _OBJECTS_VERSION = 1, 12
"""Raised when the content of a file is computed in another way."""


@dataclass(frozen=True)
class KeptObjects:
    """The objects of a scene, and the places of its phrases.

    Args:
        objects: The objects, as `lexsplat.scenes.objects.objects_of` finds them.
        places: Places where presence is decided (`lexsplat.queries.presence`).
    """

    objects: tuple[Selection, ...]
    places: DescribedPlaces


def seen_of(scene: Scene) -> Seen | None:
    """Visibility of segments in the views of a scene, from disk if kept there; None without segments."""
    segments = scene.field.segments
    if segments is None:
        return None
    training = [name for name, view in scene.views.items() if view.split == "train"]
    cameras, kept, key = scene.cameras, None, ""
    path = _path(scene, "seen")
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
    path = _path(scene, "seen")
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
        scene.embed([*PART_NAMES, *classifier.colored])
        if scene.kept is None and scene.field.segments is not None:
            _write_objects(
                scene, KeptObjects(scene.objects, classifier.places), path.with_name("objects.safetensors")
            )
        scene.write_texts()
    except OSError as error:  # such as a full disk
        why = error.strerror or str(error)
        log.log(NOTE, "%s: what the first questions need is not kept; they compute it (%s)", path.parent, why)
    except LexsplatError as error:
        # Nothing is lost: questions compute it, and report a missing encoder.
        log.debug("%s: not kept (%s)", path, str(error)[:200])


def keep_for(
    folder: SceneFolder, device: str, listener: Listener, text_tower: TextTower | None = None
) -> None:
    """`keep` for a finished scene folder.

    Args:
        folder: The scene folder.
        device: Device of the computation.
        listener: Receives the stages "words" and "views".
        text_tower: The encoder of its texts, if it is loaded already.
    """
    from lexsplat.scenes.scene import open_scene

    scene = open_scene(folder.root, device=device)
    scene.listener, scene.text_tower = listener, text_tower
    keep(scene)


def _path(scene: Scene, name: str) -> Path | None:
    return None if scene.folder is None else scene.folder.root / "checkpoints" / f"{name}.safetensors"


def kept_objects_of(scene: Scene) -> KeptObjects | None:
    """The objects of a scene from its folder; None where it keeps none that fit the scene."""
    path = _path(scene, "objects")
    if path is None or not path.exists() or scene.field.segments is None:
        return None
    try:
        tensors, facts = read_tensors(path)
        if facts.get("of") != digest(_object_parts(scene)):
            return None
        places = DescribedPlaces(tensors["places"], tuple(json.loads(facts["words"])))
        return KeptObjects(_selections(scene, tensors, json.loads(facts["objects"])), places)
    except (FileFormatError, KeyError, ValueError, TypeError, IndexError, RuntimeError) as error:
        log.warning("%s: computed again (%s)", path, str(error)[:100])
        return None


def _write_objects(scene: Scene, kept: KeptObjects, path: Path) -> None:
    """Write the objects of a scene with segments."""
    numbers = torch.full((len(scene.gaussians),), -1, dtype=torch.int32)
    for number, each in enumerate(kept.objects):
        numbers[each.indices.cpu()] = number
    boxes = [np.concatenate([part.ravel() for part in each.box]) for each in kept.objects]
    tensors = {
        "numbers": numbers.short() if len(kept.objects) < 1 << 15 else numbers,
        "boxes": torch.from_numpy(np.array(boxes).reshape(-1, 15)),
        "strengths": torch.stack([each.scores[each.indices[0]].cpu() for each in kept.objects])
        if kept.objects
        else torch.zeros(0),
        "places": kept.places.distributions.cpu().contiguous(),
    }
    facts = {
        "of": digest(_object_parts(scene)),
        "objects": json.dumps([[each.phrase, each.names] for each in kept.objects]),
        "words": json.dumps(kept.places.words),
    }
    write_tensors(path, tensors, facts)


def _selections(scene: Scene, tensors: dict[str, Tensor], entries: list) -> tuple[Selection, ...]:
    numbers, device = tensors["numbers"].long(), scene.gaussians.device
    if numbers.shape != (len(scene.gaussians),) or tensors["boxes"].shape != (len(entries), 15):
        raise ValueError("it does not fit the scene")
    strengths = torch.cat([tensors["strengths"], torch.zeros(1)])  # the last one is that of no object
    whole = scene.selection((numbers >= 0).to(device), strengths[numbers].to(device))
    members = numbers.sort(stable=True).indices.to(device)
    sizes = torch.bincount(numbers + 1, minlength=len(entries) + 1).tolist()
    found = []
    for (phrase, names), box, indices in zip(
        entries, tensors["boxes"].numpy(), members.split(sizes)[1:], strict=True
    ):
        known = tuple((str(name), float(share)) for name, share in names)
        found.append(
            whole.part(indices).described(
                phrase=str(phrase), names=known, box=Box(box[:3], box[3:12].reshape(3, 3), box[12:])
            )
        )
    return tuple(found)


def _object_parts(scene: Scene) -> Iterator[bytes]:
    """Everything that the file of objects depends on."""
    yield f"{_OBJECTS_VERSION}".encode()
    yield ((scene.seen.key if scene.seen else "") or scene_key(scene)).encode()
    for tensor in scene.field.content():
        yield np.ascontiguousarray(tensor.detach().cpu().numpy()).tobytes()
    encoder = scene.encoder_identity()
    words = (
        everyday_words(),
        default_vocabulary(scene.clip),
        sorted(STUFF),
        sorted(SURFACES),
        sorted(DIVIDED),
        encoder.get("encoder_hash", encoder["encoder"]),
    )
    yield repr((words, scene.query, scene.world.up.direction.tolist())).encode()


def scene_key(scene: Scene) -> str:
    """Hash of the Gaussians, segments and cameras of a scene."""
    return digest(_scene_parts(scene))


def _scene_parts(scene: Scene) -> Iterator[bytes]:
    yield f"{_SEEN_VERSION} {scene.gaussians.antialiased}".encode()
    gaussians, segments = scene.gaussians, scene.field.segments
    tensors = [gaussians.means, gaussians.quats, gaussians.log_scales, gaussians.opacity_logits]
    of_segments = [segments.labels, segments.masses, segments.levels] if segments else []
    if segments:
        of_segments += [mask for mask in (segments.hidden, segments.added) if mask is not None]
    for tensor in [*tensors, *of_segments]:
        yield np.ascontiguousarray(tensor.detach().cpu().numpy()).tobytes()
    for name, view in scene.views.items():
        yield f"{name}\0{view.split}\0{view.camera.width}x{view.camera.height}".encode()
        yield view.camera.K.tobytes() + view.camera.viewmat.tobytes()
