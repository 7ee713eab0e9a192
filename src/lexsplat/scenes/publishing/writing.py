"""Writes a scene as a static page: a folder for any web server, or one file that opens by double click."""

from __future__ import annotations

import base64
import re
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.queries.kinds import words_of_things
from lexsplat.queries.scoring import form_used
from lexsplat.runtime.errors import LexsplatError, QueryError, SceneFolderError
from lexsplat.runtime.files import naming, read_json, write_json
from lexsplat.runtime.progress import Event
from lexsplat.scenes.formats.language import stored_language
from lexsplat.scenes.publishing.english import english_file
from lexsplat.scenes.publishing.index import PAGE_FILES, folder_index, page_file, single_index
from lexsplat.scenes.publishing.manifest import (
    DRAWN_SPLATS,
    FORMAT,
    MOST_OBJECTS,
    checksums,
    colored_entries,
    kind_entries,
    one_line,
    scene_manifest,
)
from lexsplat.scenes.publishing.rules import everyday_rule, part_rule, segment_rule
from lexsplat.scenes.publishing.sidecar import objects_file, segments_file, splat_codes
from lexsplat.scenes.publishing.splat_file import most_visible, write_splats
from lexsplat.scenes.publishing.text_tower import write_text_tower
from lexsplat.scenes.publishing.vocabulary import offered_phrases, phrase_answers, words_file
from lexsplat.scenes.scene import Scene

MOST_SPLATS = 4_000_000
"""Gaussians that a browser draws, at most."""
SINGLE_FILE_BYTES = 50_000_000
"""Largest size of the files that go into one HTML file."""
_STAGE, _STEPS = "page", 6
"""The steps that progress events count: Gaussians, their codes, objects, phrases, text tower, manifest."""
_PLAIN_NAME = re.compile(r"\w+(\.\w+)*")


@dataclass(frozen=True)
class PublishOptions:
    """How a page is written.

    Args:
        title: Title of the page; empty takes the name of the scene folder.
        description: A sentence under the title.
        start_view: Name of the view from which the page starts; None takes the first one.
        max_splats: Number of Gaussians to publish, those that cover most; None takes all.
        words_only: Leave out the text tower: the page then answers the phrases of its dictionary only.
        single_file: Write one HTML file instead of a folder.
    """

    title: str = ""
    description: str = ""
    start_view: str | None = None
    max_splats: int | None = None
    words_only: bool = False
    single_file: bool = False


@dataclass(frozen=True)
class Published:
    """The result of publishing.

    Args:
        path: The folder or the file.
        bytes: Its size.
        splats: Number of Gaussians in it.
        phrases: Number of phrases in its dictionary.
        free_text: Whether it holds a text tower.
    """

    path: Path
    bytes: int
    splats: int
    phrases: int
    free_text: bool


def publish(scene: Scene, target: Path, options: PublishOptions | None = None) -> Published:
    """Write a scene as a page that is searched in the browser.

    Args:
        scene: The scene, with language.
        target: The folder; new, empty, or an earlier page, which is replaced. With ``single_file`` a file that ends
            in ``.html``.
        options: Title, start and what is left out.

    Raises:
        SceneFolderError: If the target holds other files, or the content is too large for one file.
        QueryError: If the scene has too few or too many Gaussians, invalid numbers, or no view of that name.
        ModelError: If the text encoder cannot be loaded.
    """
    options = options or PublishOptions()
    check_target(target, options.single_file)
    _check_scene(scene.gaussians, options.max_splats)
    target.parent.mkdir(parents=True, exist_ok=True)
    with naming(target), tempfile.TemporaryDirectory(prefix=f".{target.name}.", dir=target.parent) as work:
        folder = Path(work) / "page"
        folder.mkdir()
        manifest = _write_content(scene, folder, options)
        if options.single_file:
            written = _write_single(folder, manifest, target)
        else:
            written = _write_folder(folder, manifest, target)
    return Published(
        target,
        written,
        manifest["scene"]["gaussians"],
        manifest["words"]["count"],
        manifest["text"] is not None,
    )


def _check_scene(gaussians: Gaussians, max_splats: int | None) -> None:
    if len(gaussians) < 2:
        remedy = "undo the edit that deleted the others"
        raise QueryError("scene", expected="at least 2 Gaussians", found=str(len(gaussians)), remedy=remedy)
    if damage := gaussians.find_invalid():
        raise QueryError("scene", expected="finite Gaussians", found=damage, remedy="build the scene again")
    if min(len(gaussians), max_splats or len(gaussians)) > MOST_SPLATS:
        raise QueryError(
            "scene",
            expected=f"at most {MOST_SPLATS:,} Gaussians, which a browser can draw",
            found=f"{min(len(gaussians), max_splats or len(gaussians)):,}",
            remedy="--max-splats 2000000 publishes those that cover most",
        )


def check_target(target: Path, single_file: bool) -> None:
    """Refuse a target that would lose files of others.

    Raises:
        SceneFolderError: If it is not new, empty or an earlier page.
    """
    if single_file:
        if target.suffix.lower() != ".html":
            raise SceneFolderError(target, expected="a name that ends in .html", found=repr(target.suffix))
        if target.exists() and (not target.is_file() or FORMAT not in _head(target)):
            raise SceneFolderError(
                target,
                expected="a new file or an earlier page",
                found="another file",
                remedy="give another name",
            )
        return
    if not target.exists():
        return
    if not target.is_dir():
        raise SceneFolderError(target, expected="a folder", found="a file", remedy="give another name")
    own = _own_files(target)
    own |= {"manifest.json"} if own else set()
    foreign = sorted(path.name for path in target.iterdir() if path.name not in own or not path.is_file())
    if foreign:
        raise SceneFolderError(
            target,
            expected="a new folder, an empty one or an earlier page",
            found=f"foreign files: {', '.join(foreign[:3])}" + (", ..." if len(foreign) > 3 else ""),
            remedy="give another folder",
        )


def _head(path: Path) -> str:
    with open(path, encoding="utf-8", errors="replace") as file:
        return file.read(4096)


def _own_files(folder: Path) -> set[str]:
    """Names of the files of an earlier page in a folder; none if there is no page.

    Publishing deletes these files, and the manifest may be somebody else's: one with a path in it is not a page.
    """
    try:
        manifest = read_json(folder / "manifest.json")
    except LexsplatError:
        return set()
    if not isinstance(manifest, Mapping) or manifest.get("format") != FORMAT:
        return set()
    names = manifest.get("files")
    if not isinstance(names, Mapping) or not all(_PLAIN_NAME.fullmatch(name) for name in names):
        return set()
    return set(names)


def _write_content(scene: Scene, folder: Path, options: PublishOptions) -> dict[str, Any]:
    """Write everything but ``index.html`` and return the manifest, which is written as well."""
    start = None if options.start_view is None else scene.view(options.start_view).name
    scene.listener(Event(_STAGE, 0, _STEPS))
    kept = most_visible(scene.gaussians, options.max_splats or len(scene.gaussians))
    gaussians = scene.gaussians.select(kept.to(scene.gaussians.device)).to("cpu")
    splats, rotation = write_splats(gaussians, folder, shrink=True, listener=scene.listener)
    scene.listener(Event(_STAGE, 1, _STEPS))
    identity = scene.encoder_identity()
    language = stored_language(scene.field, identity).select(kept)
    (folder / "codes.bin").write_bytes(splat_codes(language))
    segments = scene.field.segments if form_used(scene.field, scene.query) == "segment" else None
    if segments is not None:
        content = segments_file(segments.select(kept), language.uncertainties, scene.hidden.cpu()[kept])
        (folder / "segments.bin").write_bytes(content)
    scene.listener(Event(_STAGE, 2, _STEPS))
    objects = scene.objects[:MOST_OBJECTS]
    (folder / "objects.bin").write_bytes(objects_file(objects, kept))
    scene.listener(Event(_STAGE, 3, _STEPS))
    phrases = offered_phrases(scene)
    tables, presences = phrase_answers(scene, list(phrases))
    (folder / "words.txt").write_bytes(words_file(phrases, presences))
    (folder / "words.bin").write_bytes(tables.numpy().tobytes())
    (folder / "english.bin").write_bytes(english_file())
    scene.listener(Event(_STAGE, 4, _STEPS))
    text = None
    if not options.words_only:
        text = write_text_tower(scene, folder / "text.safetensors", folder / "tokenizer.json")
    scene.listener(Event(_STAGE, 5, _STEPS))
    for name in PAGE_FILES:
        (folder / name).write_bytes(page_file(name))
    manifest = scene_manifest(scene, gaussians, splats.name, rotation, options.title, DRAWN_SPLATS)
    manifest["description"] = one_line(options.description)
    manifest["scene"]["start_view"] = start or manifest["scene"]["start_view"]
    manifest |= {
        "language": {
            "codes": "codes.bin",
            "segments": None if segments is None else "segments.bin",
            "segment_rule": None if segments is None else segment_rule(),
            "part_rule": None if segments is None else part_rule(),
            "objects": "objects.bin",
            "num_codes": scene.field.codebook.num_codes,
            "method": scene.field.method,
        },
        "words": {
            "phrases": "words.txt",
            "table": "words.bin",
            "count": len(phrases),
            "rule": everyday_rule(scene),
            "english": {
                "file": "english.bin",
                "things": words_of_things(scene.clip),
                "only": scene.clip == "bundled",
            },
        },
        "text": text,
        "objects": colored_entries(scene, objects),
        "kinds": kind_entries(objects),
        "licenses": {
            "page.js": "Apache-2.0 and those of LICENSES.txt",
            "words.txt": "Apache-2.0",
            "text.safetensors": "Apache-2.0" if scene.clip == "bundled" else f"that of {scene.clip}",
            "scene": "Apache-2.0" if scene.folder and scene.folder.is_bundled else "not stated",
        },
    }
    manifest["files"] = {path.name: checksums(path.read_bytes()) for path in sorted(folder.iterdir())}
    manifest["files"]["index.html"] = {}  # it belongs to the page; nothing reads it by its checksum
    write_json(folder / "manifest.json", manifest)
    scene.listener(Event(_STAGE, _STEPS, _STEPS))
    return manifest


def _write_folder(folder: Path, manifest: dict[str, Any], target: Path) -> int:
    """Move a finished page to its place; returns its size. The manifest of an earlier page is the last to go."""
    (folder / "index.html").write_text(folder_index(manifest), encoding="utf-8")
    size = sum(path.stat().st_size for path in folder.iterdir())
    earlier = _own_files(target) if target.exists() else set()
    target.mkdir(exist_ok=True)
    for path in sorted(folder.iterdir(), key=lambda path: path.name == "manifest.json"):
        path.replace(target / path.name)
    for name in earlier - set(manifest["files"]):
        (target / name).unlink(missing_ok=True)
    return size


def _write_single(folder: Path, manifest: dict[str, Any], target: Path) -> int:
    """Write one HTML file that holds all files as base64; returns its size."""
    data = [path for path in sorted(folder.iterdir()) if path.name not in ("page.js", "page.css")]
    size = sum(path.stat().st_size for path in data)
    if size > SINGLE_FILE_BYTES:
        raise SceneFolderError(
            target,
            expected=f"at most {SINGLE_FILE_BYTES / 1e6:.0f} MB for a single file",
            found=f"{size / 1e6:.0f} MB",
            remedy="publish a folder, or give --max-splats or --words-only",
        )
    # "</script" and "<!--" would end the element; in scripts they occur within texts only.
    script = (folder / "page.js").read_text(encoding="utf-8")
    script = script.replace("</script", "<\\/script").replace("<!--", "<\\!--")
    style = (folder / "page.css").read_text(encoding="utf-8")
    blocks = [
        f'<script type="application/octet-stream" id="file:{path.name}">'
        f"{base64.b64encode(path.read_bytes()).decode()}</script>"
        for path in data
    ]
    page = single_index(manifest, style, script, "\n".join(blocks))
    temporary = folder / "single.html"
    temporary.write_text(page, encoding="utf-8")
    temporary.replace(target)
    return target.stat().st_size
