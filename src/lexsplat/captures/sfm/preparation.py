"""Prepares photos for structure from motion: finds them, writes upright copies where needed, masks and lenses.

pycolmap reads pixels as stored: it ignores the EXIF orientation and does not read every image format. Photos that
are stored rotated, or in anything but 8-bit gray or RGB as JPEG or PNG, are therefore copied upright with their EXIF
focal length, and the others are linked beside them. If no photo needs a copy, nothing is written.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lexsplat.captures.capture import stem_of
from lexsplat.captures.images.listing import hidden_note, images_below, is_image_file
from lexsplat.captures.images.masks import IGNORE_FOLDER, INVERTED, find_ignore_masks, transparency_note
from lexsplat.captures.images.reading import (
    PhotoRows,
    Transparency,
    image_size,
    misfit,
    open_image,
    read_bytes,
    read_mask,
    resize_nearest,
    sizes_agree,
    transparency_of,
)
from lexsplat.captures.readers.camera_files import checked_name
from lexsplat.captures.readers.video import videos_in
from lexsplat.captures.sfm.remarks import (
    copies_note,
    copies_of,
    gray_note,
    left_out,
    looks_gray,
    twins,
)
from lexsplat.runtime import memory as budget
from lexsplat.runtime.errors import CaptureError
from lexsplat.runtime.files import atomic_path, link_or_copy
from lexsplat.runtime.progress import Event, Listener, silent

STAGE = "photos"

_ORIENTATION, _EXIF, _MAKE, _MODEL = 0x0112, 0x8769, 0x010F, 0x0110
_FOCAL = (0x920A, 0xA405, 0xA20E, 0xA20F, 0xA210)
"""EXIF tags of the focal length: in millimeters, as 35 mm equivalent, and sensor pixels per unit."""
_APART = (IGNORE_FOLDER, "segmentations")
_JPEG_QUALITY = 95
_BLACK_MASK = "has a mask that is black throughout: black is ignored, white is used"
_TRANSPARENT = "is transparent wherever it is not masked"
_Found = TypeVar("_Found")


@dataclass(frozen=True)
class PreparedPhotos:
    """Photos ready for structure from motion.

    Args:
        images: Folder of the photos, upright.
        names: Names of the photos relative to it, with "/", sorted.
        lenses: The same names, grouped by lens: one size and one focal length each.
        masks: Folder with ``NAME.png`` in COLMAP's layout, or None if no photo is masked.
        largest: Width and height of the photo with the most pixels.
        notes: Remarks for the user, one line each.
        blank: Why nothing of a photo is left, by name, for photos that are masked or transparent throughout.
    """

    images: Path
    names: tuple[str, ...]
    lenses: tuple[tuple[str, ...], ...]
    masks: Path | None
    largest: tuple[int, int]
    notes: tuple[str, ...] = ()
    blank: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class _Photo:
    """Header of a photo: its upright size, how it is stored, its lens, and how transparent and colored it is."""

    name: str
    size: tuple[int, int]
    orientation: int
    plain: bool
    lossy: bool
    exif: Image.Exif
    focal: tuple[Any, ...]
    transparency: Transparency
    gray: bool


def photo_folder(capture: Path) -> Path:
    """The folder that holds the photos: the given one, or its ``images/``."""
    inside = capture / "images"
    direct = capture.is_dir() and any(map(is_image_file, capture.iterdir()))
    return inside if inside.is_dir() and not direct else capture


def find_photos(folder: Path, without: Path | None = None) -> list[str]:
    """Names of all photos below a folder, relative to it, with "/", sorted.

    Args:
        folder: Folder to search; its ``masks/`` and ``segmentations/`` hold no photos, and hidden files are none.
        without: A folder to skip: the output, where that lies among the photos.
    """
    return _find(folder, without)[0]


def _find(folder: Path, without: Path | None) -> tuple[list[str], list[str]]:
    """Names of all photos below a folder, and of hidden image files."""
    apart = {folder / name for name in _APART}
    if without is not None and without.resolve() not in (folder.resolve(), *folder.resolve().parents):
        apart.add(without.resolve())
    photos, hidden = (
        sorted(
            path.relative_to(folder).as_posix()
            for path in paths
            if apart.isdisjoint([*path.parents, *path.resolve().parents])
        )
        for paths in images_below(folder)
    )
    return photos, hidden


def mask_places(folder: Path) -> list[Path]:
    """Where masks of the photos in a folder may be: ``masks/`` in it, or beside it if it is named ``images``."""
    places = [folder, folder.parent] if folder.name == "images" else [folder]
    return [place / IGNORE_FOLDER for place in places]


def prepare_photos(
    folder: Path, output: Path, *, memory: int = budget.DEFAULT_MEMORY, listener: Listener = silent
) -> PreparedPhotos:
    """Inspect a folder of photos, and write upright copies and masks where they are needed.

    Args:
        folder: The photos, in subfolders if any; ``masks/`` in it, or beside it if it is named ``images``, holds
            masks (black pixels are ignored).
        output: Folder for ``images/`` (if a photo has to be copied) and ``masks/`` (if there are any). Valid copies
            of an earlier call are kept.
        memory: Bytes of host memory available to one photo.
        listener: Receives events of stage "photos" while photos are copied.

    Raises:
        CaptureError: If there are fewer than three photos, one is unreadable, a mask does not fit its photo, or
            the output lies among the photos.
        MemoryBudgetError: If a photo is too large for ``memory``.
    """
    names = checked_photos(folder, output)
    every, hidden_files = _find(folder, output)
    largest = max(_of_all(names, lambda name: image_size(folder / name)), key=lambda size: size[0] * size[1])
    budget.check_photo(largest, memory)
    photos = _of_all(names, lambda name: _look_at(folder, name))
    largest = max((photo.size for photo in photos), key=lambda size: size[0] * size[1])
    remarks = [
        *hidden_note(hidden_files),
        *left_out(folder),
        *copies_note(copies_of(folder, every)),
        *twins(names),
    ]
    remarks += gray_note([photo.name for photo in photos if photo.gray], len(photos))
    notes = [f"{folder}: {remark}" for remark in remarks]
    found, strays = find_ignore_masks(mask_places(folder), every)
    found = {name: mask for name, mask in found.items() if name in names}
    notes += strays
    images, renamed = folder, {name: name for name in names}
    unready = not all(photo.plain and photo.orientation == 1 for photo in photos)
    hidden = [photo.name for photo in photos if photo.transparency.hides]
    masked = {*found, *hidden}
    if unready or masked:
        _refuse_output_among_photos(folder, output)
    if unready:
        images = output / "images"
        renamed = _new_names(photos)
        _copy_photos(photos, folder, images, renamed, listener)
        turned = sum(photo.orientation != 1 for photo in photos)
        converted = sum(not photo.plain for photo in photos)
        done = f"rotated upright: {turned}; converted to JPEG or PNG: {converted}"
        notes.append(f"copies of photos are in {images}: {done}")
    masks, blank = None, dict[str, str]()
    if hidden:
        notes.append(transparency_note(folder, hidden))
    if masked:
        masks, blank = _write_masks(photos, folder, found, renamed, output)
        notes.append(f"{len(masked)} of {len(names)} photos are masked")
    groups: dict[tuple[Any, ...], list[str]] = {}
    for photo in photos:
        groups.setdefault((photo.size, photo.focal), []).append(renamed[photo.name])
    lenses = tuple(tuple(sorted(group)) for group in groups.values())
    ordered = tuple(sorted(renamed.values()))
    return PreparedPhotos(images, ordered, lenses, masks, largest, tuple(notes), blank)


def _of_all(names: Sequence[str], look: Callable[[str], _Found]) -> list[_Found]:
    """What is found at each photo; all that cannot be read are named at once."""
    found, broken = [], list[CaptureError]()
    for name in names:
        try:
            found.append(look(name))
        except CaptureError as error:
            broken.append(error)
    if len(broken) == 1:
        raise broken[0]
    if broken:
        some = ", ".join(str(error.subject) for error in broken[:3]) + (
            " and more" if len(broken) > 3 else ""
        )
        raise CaptureError(
            some,
            expected=broken[0].expected,
            found=f"{len(broken)} that are not, the first: {broken[0].found}",
            remedy="replace them, or remove them from the capture",
        )
    return found


def checked_photos(folder: Path, output: Path) -> list[str]:
    """The names of `find_photos`, without exact copies of photos (`copies_of`).

    Raises:
        CaptureError: If they are fewer than three, or camera files cannot hold one of them.
    """
    if not folder.is_dir():
        raise CaptureError(
            folder,
            expected="a folder of photos, or a video",
            found="a file" if folder.exists() else "no such folder",
            remedy="give a folder" if folder.exists() else "check the path",
        )
    every = find_photos(folder, output)
    copies = copies_of(folder, every)
    names = [name for name in every if name not in copies]
    if len(names) < 3:
        videos = videos_in(folder)
        raise CaptureError(
            folder,
            expected="at least 3 photos",
            found="; ".join([str(len(names)), *copies_note(copies), *left_out(folder)]),
            remedy=f"give {folder / videos[0]}" if videos else "take 30 or more photos around the place",
        )
    for name in every:
        if not _can_be_listed(folder, name):
            raise CaptureError(
                str(folder).encode("utf-8", "backslashreplace").decode("utf-8"),
                expected="names in UTF-8, without control characters and backslashes",
                found=ascii(name)[:100],
                remedy="rename the file and its folders",
            )
    return names


def _can_be_listed(folder: Path, name: str) -> bool:
    """Whether camera files can hold a name."""
    try:
        return bool(str(folder).encode("utf-8")) and checked_name(name, folder) == name
    except (CaptureError, UnicodeEncodeError):
        return False


def upright_size(path: Path) -> tuple[int, int]:
    """Width and height of a photo turned upright by its EXIF orientation, from the header alone.

    Raises:
        CaptureError: If it is not an image.
    """
    width, height = image_size(path)
    with open_image(path) as image:
        turned = image.getexif().get(_ORIENTATION, 1) in (5, 6, 7, 8)
    return (height, width) if turned else (width, height)


def _look_at(folder: Path, name: str) -> _Photo:
    """The header of a photo."""
    path = folder / name
    width, height = image_size(path)
    with open_image(path) as image:
        exif = image.getexif()
        # Eight bits a channel without alpha, in a format every build of pycolmap reads as Pillow does.
        plain = image.format in ("JPEG", "PNG") and image.mode in ("L", "RGB")
        plain = plain and "transparency" not in image.info
        lossy = image.format not in ("PNG", "TIFF", "BMP")
        gray = image.mode in ("1", "L", "LA", "I", "I;16", "F")
        if plain:
            # Decoding at an eighth of the size finds truncated files now, in 50 ms for 12 megapixels. The other
            # photos are decoded in full when they are converted.
            image.draft("RGB", (max(1, width // 8), max(1, height // 8)))
            image.load()
            gray = looks_gray(image)
    orientation = exif.get(_ORIENTATION, 1)
    if orientation not in range(1, 9):
        orientation = 1
    sensor = exif.get_ifd(_EXIF)
    focal = (exif.get(_MAKE), exif.get(_MODEL), *(str(sensor.get(tag)) for tag in _FOCAL))
    size = (height, width) if orientation >= 5 else (width, height)
    return _Photo(name, size, orientation, plain, lossy, exif, focal, transparency_of(path), gray)


def turned_upright(pixels: NDArray[Any], orientation: int) -> NDArray[Any]:
    """Pixels ``[H, W, ...]`` as stored, rotated and flipped upright by their EXIF orientation 1 to 8."""
    if orientation in (5, 6, 7, 8):  # stored with rows and columns exchanged
        pixels = np.swapaxes(pixels, 0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return pixels


def _new_names(photos: Sequence[_Photo]) -> dict[str, str]:
    """Unique names of the copies: unchanged where the format stays, else with another suffix."""
    kept = {photo.name for photo in photos if photo.plain}
    names = {}
    for photo in photos:
        if photo.plain:
            names[photo.name] = photo.name
            continue
        suffix = ".jpg" if photo.lossy else ".png"
        name = photo.name if photo.name.endswith(suffix) else f"{stem_of(photo.name)}{suffix}"
        while name in kept:
            name = f"{photo.name}{suffix}" if name != f"{photo.name}{suffix}" else f"_{name}"
        kept.add(name)
        names[photo.name] = name
    return names


def _copy_photos(
    photos: Sequence[_Photo], folder: Path, images: Path, renamed: dict[str, str], listener: Listener
) -> None:
    """Fill ``images`` with links and copies, and delete files of other photos."""
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
                    link_or_copy(source, temporary)
                else:
                    _write_upright(photo, source, temporary)
                    # The copy gets its photo's modification time, by which the next call recognizes it.
                    os.utime(temporary, ns=(stamp, stamp))
        listener(Event(STAGE, done, len(photos)))


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
    photos: Sequence[_Photo], folder: Path, found: dict[str, Path], renamed: dict[str, str], output: Path
) -> tuple[Path, dict[str, str]]:
    """Write masks in COLMAP's layout: ``NAME.png``, black and white, upright, of the photo's size.

    Black is what the photo's mask in ``found`` ignores, and what is transparent in the photo.

    Returns:
        Their folder, and why nothing is left of a photo, by its new name, for photos of which nothing is.

    Raises:
        CaptureError: If a mask does not fit its photo, or nothing is left of any photo.
    """
    place, blank = output / IGNORE_FOLDER, dict[str, str]()
    shutil.rmtree(place, ignore_errors=True)
    for photo in photos:
        if photo.name not in found and not photo.transparency.hides:
            continue
        mask = np.ones(photo.size[::-1], bool)
        if photo.name in found:
            mask = _fitted_mask(read_mask(found[photo.name], nonzero=True), photo, found[photo.name])
        by_mask = not mask.any()
        if photo.transparency.hides:
            mask = mask & turned_upright(PhotoRows(folder / photo.name).opaque(), photo.orientation)
        with atomic_path(place / f"{renamed[photo.name]}.png") as temporary:
            Image.fromarray(mask.astype(np.uint8) * 255).save(temporary, format="PNG")
        if not mask.any():
            blank[renamed[photo.name]] = _BLACK_MASK if by_mask else _TRANSPARENT
    if len(blank) == len(photos):
        shutil.rmtree(place)
        raise CaptureError(
            folder,
            expected="photos that are not masked throughout",
            found="only such photos",
            remedy=INVERTED,
        )
    return place, blank


def _fitted_mask(mask: NDArray[np.bool_], photo: _Photo, subject: Path) -> NDArray[np.bool_]:
    """A mask ``[H, W]`` at the photo's upright size; one drawn on the stored pixels is rotated with them."""
    size = (mask.shape[1], mask.shape[0])
    if not sizes_agree(size, photo.size) and photo.orientation >= 5 and sizes_agree(size[::-1], photo.size):
        mask = turned_upright(mask, photo.orientation)
    elif not sizes_agree(size, photo.size):
        raise misfit(subject, size, photo.name, photo.size)
    return resize_nearest(mask, photo.size)


def _refuse_output_among_photos(folder: Path, output: Path) -> None:
    """Keep copies and masks from overwriting the user's own files."""
    place = output.resolve()
    if place == folder.resolve() or (folder.name == "images" and place == folder.resolve().parent):
        raise CaptureError(
            output,
            expected="an output outside the folder of the photos, which have to be rotated, converted or masked",
            found="the folder of the photos",
            remedy="give another --output",
        )
