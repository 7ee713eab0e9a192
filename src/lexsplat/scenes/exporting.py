"""Export of a scene, or of selections of it, for other programs. The file name's ending selects the format."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.geometry.world import World
from lexsplat.queries.selection import Selection
from lexsplat.queries.visibility import whole_things
from lexsplat.runtime.errors import QueryError, SceneFolderError
from lexsplat.runtime.files import atomic_path, write_json
from lexsplat.runtime.progress import NOTE, Listener, silent
from lexsplat.scenes.formats.compressed import COMPRESSED, write_compressed
from lexsplat.scenes.formats.gltf import write_glb
from lexsplat.scenes.formats.language import (
    StoredLanguage,
    codebook_path,
    ply_columns,
    stored_language,
    write_codebook,
)
from lexsplat.scenes.formats.ply import write_ply
from lexsplat.scenes.formats.sog_writing import write_sog
from lexsplat.scenes.formats.splat import WITHOUT_MIP_FLAG, write_splat
from lexsplat.scenes.formats.spz import write_spz
from lexsplat.scenes.formats.tables import write_labels_csv, write_points_ply
from lexsplat.scenes.scene import Scene

log = logging.getLogger("lexsplat")

SPLAT_ENDINGS = (".points.ply", *COMPRESSED, ".ply", ".splat", ".v3.spz", ".spz", ".sog", ".glb")
"""Formats of Gaussians or their points; the first that fits is taken."""
LABEL_ENDINGS = (".csv", ".json")
"""Formats of labels."""


def ending_of(path: str | Path) -> str:
    """The known ending of a file name, which selects the format.

    Raises:
        SceneFolderError: If it has none.
    """
    path = Path(path)
    name = path.name.lower()
    for ending in (*SPLAT_ENDINGS, *LABEL_ENDINGS):
        if name.endswith(ending):
            return ending
    raise SceneFolderError(
        path,
        expected="a name that ends in " + ", ".join((*SPLAT_ENDINGS, *LABEL_ENDINGS)),
        found=repr(path.suffix),
    )


def export_gaussians(
    gaussians: Gaussians,
    path: str | Path,
    *,
    language: StoredLanguage | None = None,
    world: World | None = None,
    overwrite: bool = False,
    listener: Listener = silent,
) -> list[Path]:
    """Write Gaussians in the format of the name's ending.

    Args:
        gaussians: The Gaussians.
        path: A name with one of `SPLAT_ENDINGS`; ``.spz`` is version 4.
        language: Codes to include, in ``.ply`` (the codebook goes into a file beside it) and ``.glb``.
        world: Up and scale of the scene, for ``.glb``: it has y up, and meters if the scale is known. The other
            formats keep the scene's axes and units, so that they match its cameras.
        overwrite: Replace files that exist.
        listener: Receives events of stage "palette" for ``.sog``.

    Returns:
        The files that were written.

    Raises:
        SceneFolderError: If the ending is unknown, the format cannot hold language or a number, or a file exists.
        QueryError: If there are no Gaussians.
        BackendError: If the format needs a library that is not installed.
    """
    path, ending = Path(path), ending_of(path)
    _check_language_fits(path, language is not None)
    if len(gaussians) == 0:
        raise QueryError(path, expected="something to write", found="no Gaussian")
    if ending in LABEL_ENDINGS:
        raise SceneFolderError(
            path, expected="phrases to label by", found="none", remedy='--select "red mug"'
        )
    writers: dict[str, Callable[[Path], object]] = {
        ".ply": lambda file: write_ply(gaussians, file, further=ply_columns(language) if language else None),
        ".points.ply": partial(write_points_ply, gaussians),
        ".splat": partial(write_splat, gaussians),
        ".spz": partial(write_spz, gaussians),
        ".v3.spz": partial(write_spz, gaussians, version=3),
        ".sog": partial(write_sog, gaussians, listener=listener),
        ".glb": partial(write_glb, gaussians, language=language, world=world),
        **{name: partial(write_compressed, gaussians, kind=kind) for name, kind in COMPRESSED.items()},
    }
    written = [path]
    if language is not None and ending == ".ply":
        written.append(codebook_path(path))
    if not overwrite:
        _refuse_existing(written)
    if len(written) > 1 and language is not None:
        with atomic_path(written[-1]) as temporary:
            write_codebook(language, temporary)
    with atomic_path(path) as temporary:
        try:
            writers[ending](temporary)
        except ValueError as error:  # numbers that the format cannot hold
            remedy = "write .ply, or delete what is far away"
            expected = f"Gaussians that {ending} can hold"
            raise SceneFolderError(path, expected=expected, found=str(error), remedy=remedy) from error
    if gaussians.antialiased and ending in WITHOUT_MIP_FLAG:
        told = "%s: %s cannot say that the Gaussians need the mip filter, without which thin ones look too bold; %s"
        log.log(NOTE, told, path, ending, "use .ply, .spz, .sog or .glb where the program reads one of them")
    return written


def export_scene(
    scene: Scene,
    path: str | Path,
    *,
    found: Sequence[Selection] = (),
    language: bool = False,
    overwrite: bool = False,
) -> list[Path]:
    """Write a scene, or selections of it, or which Gaussian belongs to which selection.

    Args:
        scene: The scene.
        path: A splat format (see `export_gaussians`); ``.csv`` for one line per Gaussian of the scene, with an empty
            label where no selection has it; ``.json`` for the selections with boxes and indices.
        found: Selections (`Scene.find`); splat formats then hold only their Gaussians.
        language: Include codes and codebook.
        overwrite: Replace files that exist; files of the scene itself are never replaced.

    Returns:
        The files that were written.

    Raises:
        QueryError: If nothing is selected.
        SceneFolderError: See `export_gaussians`; also for labels without selections.
    """
    path, ending = Path(path), ending_of(path)
    _check_language_fits(path, language)
    if scene.folder is not None:
        scene.folder.refuse_own_file(path)
    if ending in LABEL_ENDINGS and found:
        _require_something(found, found)
        if not overwrite:
            _refuse_existing([path])
        with atomic_path(path) as temporary:
            if ending == ".csv":
                labels, scores = best_labels(found)
                names = [selection.phrase for selection in found]
                write_labels_csv(scene.gaussians, labels, scores, names, temporary)
            else:
                write_json(temporary, {**scene.world.to_json(), **labels_as_json(found)})
        return [path]
    stored = stored_language(scene.field, scene.encoder_identity()) if language else None
    gaussians = scene.gaussians
    if found:
        things = exported(scene, path, found)
        _require_something(found, things)
        mask = torch.stack([thing.mask for thing in things]).any(0)
        gaussians = gaussians.select(mask)
        stored = stored.select(mask.cpu()) if stored else None
    return export_gaussians(
        gaussians, path, language=stored, world=scene.world, overwrite=overwrite, listener=scene.listener
    )


def _require_something(found: Sequence[Selection], things: Sequence[Selection]) -> None:
    """Refuse phrases that select nothing, in every format."""
    if not any(things):
        raise QueryError(
            ", ".join(selection.phrase for selection in found),
            expected="something to write",
            found="nothing",
            remedy="try other words or a lower threshold",
        )


def exported(scene: Scene, path: Path, found: Sequence[Selection]) -> list[Selection]:
    """What a file holds of selections: in a splat format their things with what is hidden in them."""
    if ending_of(path) in LABEL_ENDINGS:
        return list(found)
    return [whole_things(selection, scene.hidden, scene.field.segments) for selection in found]


def _refuse_existing(files: Sequence[Path]) -> None:
    for path in files:
        if path.exists():
            raise SceneFolderError(
                path,
                expected="a new file",
                found="one that exists",
                remedy="give another name, or allow overwriting",
            )


def _check_language_fits(path: Path, language: bool) -> None:
    """Refuse language in a format that cannot hold it."""
    if language and ending_of(path) not in (".ply", ".glb"):
        raise SceneFolderError(
            path, expected="a name that ends in .ply or .glb", found="a format without room for language"
        )


def best_labels(found: Sequence[Selection]) -> tuple[Tensor, Tensor]:
    """The selection that claims each Gaussian: its number or -1, and its score, both ``[N]``.

    If several do, the one with the largest margin above its own threshold, relative to the range above it.
    """
    scores = torch.stack([selection.scores for selection in found])
    limits = scores.new_tensor([selection.threshold for selection in found])[:, None]
    claimed = torch.stack([selection.mask for selection in found])
    margin = torch.where(claimed, (scores - limits) / (1 - limits).clamp_min(1e-6), -torch.inf)
    best = margin.argmax(0)
    labels = torch.where(claimed.any(0), best, -1)
    return labels.cpu(), scores.gather(0, best[None])[0].cpu()


def labels_as_json(found: Sequence[Selection]) -> dict[str, object]:
    """The selections as plain data, with the indices of the Gaussians of every instance.

    Unlike `Selection.to_dict`, it lists instances even if "present" is "no": a selection is exported as it is.
    """
    entries = []
    for selection in found:
        instances = [
            {**instance.geometry(), "indices": instance.indices.tolist()} for instance in selection.instances
        ]
        listed = {"count": len(instances), "best_view": selection.best_view, "instances": instances}
        entries.append({**selection.to_dict(), **listed})
    return {"gaussians": len(found[0].mask), "labels": entries}
