"""The objects of a scene as its folder keeps them, so that the first question about things and places is fast.

``checkpoints/objects.safetensors`` is written whole or not at all, with ``checkpoints/seen.safetensors``
(`lexsplat.scenes.kept`). It names the scene, encoder, vocabularies and query that it was computed with. A file of
others, or a damaged one, counts as none. Dimension letters: N Gaussians, O objects, V places, K codes.
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
from lexsplat.queries.presence import DescribedPlaces
from lexsplat.queries.selection import Selection
from lexsplat.queries.vocabulary import STUFF, default_vocabulary
from lexsplat.runtime.errors import FileFormatError
from lexsplat.runtime.files import read_tensors, write_tensors
from lexsplat.runtime.fingerprints import digest

if TYPE_CHECKING:
    from lexsplat.scenes.scene import Scene

log = logging.getLogger("lexsplat")

FILE = "objects.safetensors"
_VERSION = 3
"""Raised when the content is computed in another way."""


@dataclass(frozen=True)
class KeptObjects:
    """What a file of objects holds.

    Args:
        objects: The objects, as `lexsplat.scenes.objects.objects_of` finds them.
        places: Where presence is decided (`lexsplat.queries.presence`).
    """

    objects: tuple[Selection, ...]
    places: DescribedPlaces


def read_objects(scene: Scene, path: Path) -> KeptObjects | None:
    """The objects of a scene from a file; None where it does not fit the scene."""
    if not path.exists() or scene.field.segments is None:
        return None
    try:
        tensors, facts = read_tensors(path)
        if facts.get("of") != digest(_parts(scene)):
            return None
        places = DescribedPlaces(tensors["places"], tuple(json.loads(facts["words"])))
        return KeptObjects(_selections(scene, tensors, json.loads(facts["objects"])), places)
    except (FileFormatError, KeyError, ValueError, TypeError, IndexError, RuntimeError) as error:
        log.warning("%s: computed again (%s)", path, str(error)[:100])
        return None


def write_objects(scene: Scene, kept: KeptObjects, path: Path) -> None:
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
        "of": digest(_parts(scene)),
        "objects": json.dumps([[each.phrase, each.names] for each in kept.objects]),
        "words": json.dumps(kept.places.words),
    }
    write_tensors(path, tensors, facts)


def _selections(scene: Scene, tensors: dict[str, Tensor], entries: list) -> tuple[Selection, ...]:
    numbers, device = tensors["numbers"].long(), scene.gaussians.device
    if numbers.shape != (len(scene.gaussians),) or tensors["boxes"].shape != (len(entries), 15):
        raise ValueError("it does not fit the scene")
    strengths = torch.cat([tensors["strengths"], torch.zeros(1)])  # the last one is that of no object
    whole = Selection(
        scene.gaussians,
        scene.cameras,
        (numbers >= 0).to(device),
        strengths[numbers].to(device),
        world=scene.world,
        seen=scene.seen,
    )
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


def _parts(scene: Scene) -> Iterator[bytes]:
    """Everything that the file depends on."""
    from lexsplat.scenes.kept import scene_key

    yield f"{_VERSION}".encode()
    yield ((scene.seen.key if scene.seen else "") or scene_key(scene)).encode()
    for tensor in scene.field.content():
        yield np.ascontiguousarray(tensor.detach().cpu().numpy()).tobytes()
    encoder = scene.encoder_identity()
    words = (
        everyday_words(),
        default_vocabulary(scene.clip),
        sorted(STUFF),
        encoder.get("encoder_hash", encoder["encoder"]),
    )
    yield repr((words, scene.query, scene.world.up.direction.tolist())).encode()
