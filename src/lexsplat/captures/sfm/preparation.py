"""Photos made ready for structure from motion: which there are, upright copies where needed, masks, lenses.

pycolmap takes pixels as they are stored: it does not turn a photo by its EXIF orientation, and it does not read
every kind of picture. Photos that are stored turned, or in a kind that it does not read alike (anything but 8-bit
gray or RGB in JPEG or PNG), are therefore copied, upright and with the focal length of their EXIF data; the others
are linked beside them. Where no photo needs it, nothing is copied.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lexsplat.captures.images.masks import IGNORE_FOLDER, find_ignore_masks
from lexsplat.captures.images.reading import (
    IMAGE_SUFFIXES,
    image_size,
    open_image,
    read_bytes,
    read_mask,
    sizes_agree,
)
from lexsplat.captures.readers.camera_files import checked_name
from lexsplat.runtime import memory as budget
from lexsplat.runtime.errors import CaptureError
from lexsplat.runtime.files import atomic_path
from lexsplat.runtime.progress import Event, Listener, silent

STAGE = "photos"

_ORIENTATION, _EXIF, _MAKE, _MODEL = 0x0112, 0x8769, 0x010F, 0x0110
_FOCAL = (0x920A, 0xA405, 0xA20E, 0xA20F, 0xA210)
"""EXIF tags a focal length is worked out from: in millimeters, for 35 mm film, and pixels a unit of the sensor."""
_APART = (IGNORE_FOLDER, "segmentations")
_JPEG_QUALITY = 95


@dataclass(frozen=True)
class PreparedPhotos:
    """Photos as structure from motion takes them.

    Args:
        images: Folder of the photos, upright.
        names: Names of the photos in it, with "/", sorted.
        lenses: The same names in groups that share a lens: one size and one focal length each.
        masks: Folder with ``NAME.png`` as COLMAP wants it, or None where no photo is masked.
        largest: Width and height of the photo with the most pixels.
        notes: What people should know, one line each.
    """

    images: Path
    names: tuple[str, ...]
    lenses: tuple[tuple[str, ...], ...]
    masks: Path | None
    largest: tuple[int, int]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Photo:
    """What the header of a photo says: its size upright, how it is stored, and its lens."""

    name: str
    size: tuple[int, int]
    orientation: int
    plain: bool
    lossy: bool
    exif: Image.Exif
    focal: tuple[Any, ...]


def photo_folder(capture: Path) -> Path:
    """Where the photos of a folder are: in itself, or in its ``images/``."""
    inside = capture / "images"
    direct = capture.is_dir() and any(file.suffix.lower() in IMAGE_SUFFIXES for file in capture.iterdir())
    return inside if inside.is_dir() and not direct else capture


def find_photos(folder: Path, without: Path | None = None) -> list[str]:
    """Names of all photos below a folder, relative to it, with "/", sorted.

    Args:
        folder: Where to look; its ``masks/`` and ``segmentations/`` hold no photos.
        without: A folder that is passed over: the output, where that lies among the photos.
    """
    apart = {folder / name for name in _APART}
    if without is not None and without.resolve() not in (folder.resolve(), *folder.resolve().parents):
        apart.add(without.resolve())
    found = (
        path
        for path in folder.rglob("*")
        if path.suffix.lower() in IMAGE_SUFFIXES and path.is_file() and apart.isdisjoint(_all_parents(path))
    )
    return sorted(path.relative_to(folder).as_posix() for path in found)


def _all_parents(path: Path) -> set[Path]:
    return {*path.parents, *path.resolve().parents}


def mask_places(folder: Path) -> list[Path]:
    """Where masks of the photos in a folder may be: ``masks/`` in it, or beside it where it is called ``images``."""
    return [
        place / IGNORE_FOLDER for place in (folder, *([folder.parent] if folder.name == "images" else []))
    ]


def prepare_photos(
    folder: Path, output: Path, *, memory: int = budget.DEFAULT_MEMORY, listener: Listener = silent
) -> PreparedPhotos:
    """Look at a folder of photos, and write upright copies and masks where they are needed.

    Args:
        folder: The photos, in subfolders if wanted; ``masks/`` in it, or beside it where it is called ``images``,
            holds masks (black where pixels do not count).
        output: Folder for ``images/`` (only where a photo has to be copied) and ``masks/`` (only where there are
            some). Copies that are there from an earlier call and still fit are kept.
        memory: Bytes of host memory that a photo on its way may take.
        listener: Hears of stage "photos" while photos are copied.

    Raises:
        CaptureError: If there are fewer than three photos, one is unreadable, a mask does not fit its photo, or
            the output would come to lie among the photos.
        MemoryBudgetError: If a photo is too large for ``memory``.
    """
    names = _checked_names(folder, output)
    largest = max((image_size(folder / name) for name in names), key=lambda size: size[0] * size[1])
    budget.check_photo(largest, memory)
    photos = [_look_at(folder, name) for name in names]
    largest = max((photo.size for photo in photos), key=lambda size: size[0] * size[1])
    notes: list[str] = []
    found, strays = find_ignore_masks(mask_places(folder), names)
    notes += strays
    images, renamed = folder, {name: name for name in names}
    if not all(photo.plain and photo.orientation == 1 for photo in photos):
        _refuse_output_among_photos(folder, output)
        images = output / "images"
        renamed = _new_names(photos)
        _copy_photos(photos, folder, images, renamed, listener)
        turned = sum(photo.orientation != 1 for photo in photos)
        converted = sum(not photo.plain for photo in photos)
        notes.append(f"{turned} photos turned upright and {converted} of other kinds converted in {images}")
    masks = None
    if found:
        masks = _write_masks(photos, found, renamed, folder, output)
        notes.append(f"{len(found)} of {len(names)} photos are masked")
    groups: dict[tuple[Any, ...], list[str]] = {}
    for photo in photos:
        groups.setdefault((photo.size, photo.focal), []).append(renamed[photo.name])
    lenses = tuple(tuple(sorted(group)) for group in groups.values())
    return PreparedPhotos(images, tuple(sorted(renamed.values())), lenses, masks, largest, tuple(notes))


def _checked_names(folder: Path, output: Path) -> list[str]:
    if not folder.is_dir():
        raise CaptureError(
            folder, expected="a folder of photos", found="no such folder", remedy="check the path"
        )
    names = find_photos(folder, output)
    if len(names) < 3:
        raise CaptureError(
            folder,
            expected="at least 3 photos",
            found=str(len(names)),
            remedy="take 30 or more photos around the place",
        )
    for name in names:
        _check_name(folder, name)
    return names


def _check_name(folder: Path, name: str) -> None:
    """Refuse a name that the camera files cannot hold, before hours of work lead to it.

    Raises:
        CaptureError: If the name, or the folder's, is not in UTF-8, or has a line break or a backslash in it.
    """
    try:
        str(folder).encode("utf-8")
        plain = checked_name(name, folder) == name
    except (CaptureError, UnicodeEncodeError):
        plain = False
    if not plain:
        raise CaptureError(
            str(folder).encode("utf-8", "backslashreplace").decode("utf-8"),
            expected="names in UTF-8, without control characters and backslashes",
            found=ascii(name)[:100],
            remedy="rename the file and its folders",
        )


def _look_at(folder: Path, name: str) -> _Photo:
    """What the header of a photo says.

    Raises:
        CaptureError: If it is no picture, or not a whole one.
    """
    path = folder / name
    width, height = image_size(path)
    with open_image(path) as image:
        exif = image.getexif()
        # Eight bits a channel without alpha, in a kind every build of pycolmap reads as Pillow does.
        plain = image.format in ("JPEG", "PNG") and image.mode in ("L", "RGB")
        plain = plain and "transparency" not in image.info
        lossy = image.format not in ("PNG", "TIFF", "BMP")
        if plain:
            # The others are read whole when they are converted. At an eighth of the size this takes a twentieth of
            # a second for 12 megapixels, and a photo that is cut off is told now.
            image.draft("RGB", (width // 8, height // 8))
            image.load()
    orientation = exif.get(_ORIENTATION, 1)
    if orientation not in range(1, 9):
        orientation = 1
    sensor = exif.get_ifd(_EXIF)
    focal = (exif.get(_MAKE), exif.get(_MODEL), *(str(sensor.get(tag)) for tag in _FOCAL))
    size = (height, width) if orientation >= 5 else (width, height)
    return _Photo(name, size, orientation, plain, lossy, exif, focal)


def turned_upright(pixels: NDArray[Any], orientation: int) -> NDArray[Any]:
    """An array of pixels ``[H, W, ...]`` as it is stored, turned as EXIF orientation 1 to 8 says it is to be seen."""
    if orientation in (5, 6, 7, 8):  # stored with rows and columns exchanged
        pixels = np.swapaxes(pixels, 0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return pixels


def _new_names(photos: Sequence[_Photo]) -> dict[str, str]:
    """Names of the copies: as before where the kind stays, else with another suffix, never twice the same."""
    kept = {photo.name for photo in photos if photo.plain}
    names = {}
    for photo in photos:
        if photo.plain:
            names[photo.name] = photo.name
            continue
        suffix = ".jpg" if photo.lossy else ".png"
        stem = Path(photo.name).with_suffix("").as_posix()
        name = photo.name if photo.name.endswith(suffix) else f"{stem}{suffix}"
        while name in kept:
            name = f"{photo.name}{suffix}" if name != f"{photo.name}{suffix}" else f"_{name}"
        kept.add(name)
        names[photo.name] = name
    return names


def _copy_photos(
    photos: Sequence[_Photo], folder: Path, images: Path, renamed: dict[str, str], listener: Listener
) -> None:
    """Fill ``images`` with links and copies, and take out what is of earlier photos."""
    wanted = {images / name for name in renamed.values()}
    for file in list(images.rglob("*")) if images.is_dir() else []:
        if file.is_file() and file not in wanted and not file.name.startswith("."):
            file.unlink()
    listener(Event(STAGE, 0, len(photos)))
    for done, photo in enumerate(photos, start=1):
        source, target = folder / photo.name, images / renamed[photo.name]
        stamp = source.stat().st_mtime_ns
        if not (target.is_file() and target.stat().st_mtime_ns == stamp):
            with atomic_path(target) as temporary:
                if photo.plain and photo.orientation == 1:
                    _link(source, temporary)
                else:
                    _write_upright(photo, source, temporary)
                    os.utime(
                        temporary, ns=(stamp, stamp)
                    )  # a copy is as old as its photo: so it is known again
        listener(Event(STAGE, done, len(photos)))


def _link(source: Path, target: Path) -> None:
    try:
        os.link(source, target)
    except OSError:  # another file system, or one without links
        shutil.copy2(source, target)


def _write_upright(photo: _Photo, source: Path, target: Path) -> None:
    image = Image.fromarray(np.ascontiguousarray(turned_upright(read_bytes(source), photo.orientation)))
    exif = Image.Exif()
    for tag in (_MAKE, _MODEL):
        if tag in photo.exif:
            exif[tag] = photo.exif[tag]
    sensor = photo.exif.get_ifd(_EXIF)
    kept = exif.get_ifd(_EXIF)
    kept.update({tag: sensor[tag] for tag in _FOCAL if tag in sensor})
    if photo.orientation >= 5 and 0xA20E in kept and 0xA20F in kept:  # pixels a unit along x and y
        kept[0xA20E], kept[0xA20F] = kept[0xA20F], kept[0xA20E]
    if photo.lossy:
        image.save(target, format="JPEG", quality=_JPEG_QUALITY, subsampling=0, exif=exif)
    else:
        image.save(target, format="PNG", compress_level=1, exif=exif)


def _write_masks(
    photos: Sequence[_Photo],
    found: dict[str, Path],
    renamed: dict[str, str],
    folder: Path,
    output: Path,
) -> Path:
    """Masks as COLMAP reads them: ``NAME.png``, black and white, upright, of the photo's size."""
    _refuse_output_among_photos(folder, output)
    place = output / IGNORE_FOLDER
    shutil.rmtree(place, ignore_errors=True)
    for photo in photos:
        if photo.name not in found:
            continue
        mask = read_mask(found[photo.name], nonzero=True)
        mask = _fitted_mask(mask, photo, found[photo.name])
        with atomic_path(place / f"{renamed[photo.name]}.png") as temporary:
            Image.fromarray(mask.astype(np.uint8) * 255).save(temporary, format="PNG")
    return place


def _fitted_mask(mask: NDArray[np.bool_], photo: _Photo, subject: Path) -> NDArray[np.bool_]:
    """A mask ``[H, W]`` of the photo's upright size; one drawn on the stored pixels is turned with them.

    Raises:
        CaptureError: If it is of another shape than the photo.
    """
    size = (mask.shape[1], mask.shape[0])
    if not sizes_agree(size, photo.size) and photo.orientation >= 5 and sizes_agree(size[::-1], photo.size):
        mask = turned_upright(mask, photo.orientation)
    elif not sizes_agree(size, photo.size):
        raise CaptureError(
            subject,
            expected=f"a mask of {photo.name}, {photo.size[0]}x{photo.size[1]} pixels or scaled uniformly",
            found=f"{size[0]}x{size[1]}",
            remedy="draw the mask on this photo, or remove it",
        )
    rows = ((np.arange(photo.size[1]) + 0.5) * mask.shape[0] / photo.size[1]).astype(np.int64)
    columns = ((np.arange(photo.size[0]) + 0.5) * mask.shape[1] / photo.size[0]).astype(np.int64)
    return mask[rows[:, None], columns[None, :]]


def _refuse_output_among_photos(folder: Path, output: Path) -> None:
    """Copies and masks never take the place of a user's own."""
    place = output.resolve()
    if place == folder.resolve() or (folder.name == "images" and place == folder.resolve().parent):
        raise CaptureError(
            output,
            expected="an output beside the photos, because they have to be turned, converted or masked",
            found="the photos' own folder",
            remedy="give another --output",
        )
