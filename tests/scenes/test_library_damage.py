"""A damaged library is reported, answers with what is whole, and recovers what can be recovered."""

import dataclasses
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from safetensors import safe_open
from support.library_scenes import OTHERS, contents, hits, write_scene

from lexsplat.runtime.errors import FileFormatError, LibraryError
from lexsplat.runtime.files import read_json, read_tensors, write_json, write_tensors
from lexsplat.runtime.progress import NOTE
from lexsplat.scenes.library import Library
from lexsplat.scenes.library.entries import Codes, map_codes
from lexsplat.scenes.library.records import read_record, write_record

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("room_encoders")]


def damage(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


@pytest.mark.parametrize(
    "harm",
    [
        damage,
        lambda path: path.write_bytes(b""),
        lambda path: path.write_bytes(path.read_bytes()[:-9]),
        Path.unlink,
    ],
    ids=["one bit", "empty", "truncated", "missing"],
)
def test_damaged_codes_are_refused_and_repaired_from_the_scene(rooms_copy, harm, caplog):
    before = contents(rooms_copy / "library" / "scenes")
    (file,) = (rooms_copy / "library" / "scenes").glob("kitchen.*.safetensors")
    harm(file)
    library = Library(rooms_copy / "library")
    found = library.search("mug")
    assert [hit.scene for hit in found.hits] == ["lab"]
    assert "--repair" in found.skipped["kitchen"]
    assert library.verify().keys() == {"kitchen"}
    with caplog.at_level(NOTE):
        assert library.verify(repair=True) == {}
    assert caplog.messages == ["kitchen: repaired"]
    assert contents(library.stage).keys() == before.keys()
    assert sorted(hits(library, "mug")) == ["kitchen", "lab"]


def test_every_byte_of_the_codes_is_checked_before_it_answers(rooms_copy):
    """Also where the byte makes no code larger: a scene that damage rules out would be missed without a word."""
    (file,) = (rooms_copy / "library" / "scenes").glob("kitchen.*.safetensors")
    whole = file.read_bytes()
    header = 8 + int.from_bytes(whole[:8], "little")
    for place in np.random.default_rng(0).integers(header, len(whole), 40):
        file.write_bytes(whole[:place] + bytes([whole[place] ^ 16]) + whole[place + 1 :])
        library = Library(rooms_copy / "library")
        assert library.codes(library.record("kitchen")) is None
        assert "damaged" in str(library.damaged["kitchen"])


def test_verify_finds_damage_that_keeps_the_checksum(rooms_copy):
    """A checksum is no hash: whoever knows it can change codes and keep it. `verify` compares hashes."""
    (file,) = (rooms_copy / "library" / "scenes").glob("kitchen.*.safetensors")
    damage(file)
    known = Library(rooms_copy / "library").record("kitchen")
    with pytest.raises(FileFormatError, match="the checksum differs"):
        map_codes(file, known)
    with safe_open(file, framework="pt") as changed:
        codes = Codes(*(changed.get_tensor(field.name) for field in dataclasses.fields(Codes)))
    write_record(
        dataclasses.replace(known, checksum=codes.checksum()),
        rooms_copy / "library" / "scenes" / "kitchen.json",
    )
    library = Library(rooms_copy / "library")
    assert library.codes(library.record("kitchen")) is not None
    assert "the hash differs" in library.verify()["kitchen"]
    assert library.verify(repair=True) == {}


def test_libraries_that_were_made_without_checksums_are_checked_by_hashes(rooms_copy):
    path = rooms_copy / "library" / "scenes" / "kitchen.json"
    record = read_json(path)
    for name in ("checksum", "stamp", "hash"):
        record.pop(name)
    write_json(path, record)
    assert sorted(hits(Library(rooms_copy / "library"), "mug")) == ["kitchen", "lab"]
    damage(next((rooms_copy / "library" / "scenes").glob("kitchen.*.safetensors")))
    assert "the hash differs" in Library(rooms_copy / "library").search("mug").skipped["kitchen"]


@pytest.mark.parametrize(
    "text",
    ["", "{", "[]", "{}", "null", '{"name": "office"}', '{"name": "../../x"}', "\0\0\0\0"],
)
def test_a_damaged_record_is_reported_and_recovered_from_the_codes(rooms_copy, text):
    before = contents(rooms_copy / "library" / "scenes")
    (rooms_copy / "library" / "scenes" / "kitchen.json").write_text(text)
    library = Library(rooms_copy / "library")
    assert library.search("mug").skipped.keys() == {"kitchen"}
    library.remove("office")  # other work goes on, and keeps what repairs the record
    assert library.verify(repair=True) == {}
    assert (
        json.loads(contents(library.stage)["kitchen.json"])["content"]
        == json.loads(before["kitchen.json"])["content"]
    )


def test_every_changed_byte_of_a_record_is_found_and_repaired(rooms_copy):
    """A record without its hash is taken as one of an earlier library: only its own name can be lost that way."""
    path = rooms_copy / "library" / "scenes" / "kitchen.json"
    expected = Library(rooms_copy / "library").add(rooms_copy / "kitchen")
    whole = path.read_bytes()
    for place in range(0, len(whole), 3):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        library = Library(rooms_copy / "library")
        assert library.record("kitchen") in (expected, None)
        if library.record("kitchen") is None:
            assert "--repair" in library.search("griffin").skipped["kitchen"]
    assert library.verify(repair=True) == {}
    assert library.record("kitchen") == expected


def test_a_record_is_recovered_without_its_scene(rooms_copy):
    Library(rooms_copy / "library").add(rooms_copy / "kitchen")
    shutil.rmtree(rooms_copy / "kitchen")
    path = rooms_copy / "library" / "scenes" / "kitchen.json"
    before = path.read_bytes()
    path.write_bytes(b"")
    (problem,) = Library(rooms_copy / "library").verify(repair=True).values()
    assert "no such folder" in problem
    assert path.read_bytes() == before


def test_a_lost_record_is_reported_and_written_again(rooms_copy):
    library = Library(rooms_copy / "library")
    before = (library.stage / "kitchen.json").read_bytes()
    (library.stage / "kitchen.json").unlink()
    library.remove("office")  # other changes keep its codes
    for told in (library.search("mug").skipped["kitchen"], library.verify()["kitchen"]):
        assert "found files without one" in told
        assert told.endswith(f"lexsplat library verify {library.root} --repair")
    assert library.verify(repair=True) == {}
    assert (library.stage / "kitchen.json").read_bytes() == before
    assert sorted(hits(library, "mug")) == ["kitchen", "lab"]


def test_files_that_nothing_can_be_recovered_from_are_reported_with_another_remedy(rooms_copy):
    library = Library(rooms_copy / "library")
    damage(library.stage / library.record("kitchen").codes_file)
    (library.stage / "kitchen.json").unlink()
    told = library.verify(repair=True)["kitchen"]
    assert told.endswith(f"; add the scene again, or: lexsplat library remove {library.root} kitchen")
    assert library.remove("kitchen") == "kitchen"
    assert not list(library.stage.glob("kitchen*"))
    assert library.verify() == {}


@pytest.mark.parametrize("text", [None, "{}"])
def test_a_scene_whose_record_is_lost_keeps_its_name_from_others(rooms_copy, text):
    library = Library(rooms_copy / "library")
    path = library.stage / "kitchen.json"
    path.unlink() if text is None else path.write_text(text)
    shutil.copytree(rooms_copy / "office", rooms_copy / "other" / "kitchen")
    assert library.add(rooms_copy / "other" / "kitchen").name == "kitchen-2"
    assert library.add(rooms_copy / "kitchen").name == "kitchen"
    assert library.verify(repair=True) == {}
    assert sorted(hits(library, "mug")) == ["kitchen", "lab"]


def test_codes_that_a_damaged_record_of_an_early_library_does_not_name_stay(rooms_copy):
    path = rooms_copy / "library" / "scenes" / "kitchen.json"
    record = read_json(path)
    record.pop("hash")
    write_json(path, {**record, "content": "0" * 24})
    library = Library(rooms_copy / "library")
    shutil.rmtree(rooms_copy / "kitchen")
    library.remove("office")
    assert list(library.stage.glob("kitchen.*.safetensors"))


def test_a_record_with_a_path_that_no_file_can_have_is_reported(rooms_copy):
    path = rooms_copy / "library" / "scenes" / "kitchen.json"
    write_record(dataclasses.replace(read_record(path), path="/a\0b", beside="../nowhere"), path)
    assert "no such folder" in Library(rooms_copy / "library").search("griffin").skipped["kitchen"]


def test_a_removal_that_was_killed_is_finished_and_not_undone(rooms_copy, monkeypatch):
    library = Library(rooms_copy / "library")
    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", lambda *_, **__: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            library.remove("kitchen")
    assert list(library.stage.glob("kitchen.*.safetensors"))
    assert library.search("vase").skipped == library.verify() == library.verify(repair=True) == {}
    assert not list(library.stage.glob("kitchen*"))


def test_a_scene_with_a_damaged_record_is_removed_with_all_its_files(rooms_copy):
    (rooms_copy / "library" / "scenes" / "kitchen.json").write_text("[]")
    library = Library(rooms_copy / "library")
    library.search("mug")
    assert library.remove("kitchen") == "kitchen"
    assert not list(library.stage.glob("kitchen*"))
    assert library.verify() == {}


def test_a_record_whose_copy_is_damaged_as_well_is_reported_with_another_remedy(rooms_copy):
    library = Library(rooms_copy / "library")
    codes = library.stage / library.record("kitchen").codes_file
    write_tensors(codes, read_tensors(codes)[0], {"record": "{}"})
    assert "expected the copy of the record" in library.verify()["kitchen"]
    (library.stage / "kitchen.json").write_text("{}")
    told = library.verify(repair=True)["kitchen"]
    assert told.endswith(f"; lexsplat library remove {library.root} kitchen, and add the scene again")


def test_a_damaged_copy_of_a_record_is_written_again(rooms_copy):
    library = Library(rooms_copy / "library")
    codes = library.stage / library.record("kitchen").codes_file
    whole = codes.read_bytes()
    codes.write_bytes(whole.replace(b"kitchen", b"kitchem", 1))
    assert library.verify().keys() == {"kitchen"}
    assert library.verify(repair=True) == {}


def test_verify_finds_a_scene_that_cannot_be_opened(rooms_copy):
    (rooms_copy / "kitchen" / "language.safetensors").unlink()
    (rooms_copy / "office" / "gaussians.ply").write_bytes(b"ply\n")
    found = Library(rooms_copy / "library").verify()
    assert found.keys() == {"kitchen", "office"}
    assert "language.safetensors" in found["kitchen"]
    assert "gaussians.ply" in found["office"]


def test_a_change_of_a_moved_library_leaves_nothing_at_its_old_place(rooms_copy):
    library = Library(rooms_copy / "library")
    library.root.rename(rooms_copy / "moved")
    for change in (
        lambda: library.add(rooms_copy / "kitchen"),
        lambda: library.remove("kitchen"),
        lambda: library.verify(repair=True),
    ):
        with pytest.raises(LibraryError, match="moved or deleted"):
            change()
        assert not library.root.exists()
    (rooms_copy / "moved").rename(library.root)
    assert library.verify() == {}


def test_verify_finds_a_rebuilt_scene_whose_file_has_kept_size_and_time(rooms_copy):
    library, path = Library(rooms_copy / "library"), rooms_copy / "kitchen" / "scene.json"
    times = path.stat()
    path.write_text(path.read_text().replace('"l1"', '"l2"'))
    os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
    assert "rebuilt" in library.verify()["kitchen"]


def test_files_of_others_are_never_deleted(rooms_copy):
    """A folder named ``scenes`` of a project is no library, and what a library did not write stays."""
    project = rooms_copy / "project"
    shutil.copytree(rooms_copy / "kitchen", project / "scenes")
    (project / "scenes" / "photo.jpg").write_bytes(b"mine")
    before = contents(project / "scenes")
    with pytest.raises(LibraryError, match="other files"):
        Library.create(project)
    with pytest.raises(LibraryError, match="make one with"):
        Library(project)
    assert contents(project / "scenes") == before
    library = Library(rooms_copy / "library")
    for name in ("photo.jpg", "features.safetensors", "notes.json.txt"):
        (library.stage / name).write_bytes(b"mine")
    library.remove("office")
    library.add(rooms_copy / "office")
    assert library.verify(repair=True) == {}
    assert {"photo.jpg", "features.safetensors", "notes.json.txt"} <= contents(library.stage).keys()
    (rooms_copy / "photos" / "thumbnails" / "kitchen").mkdir(parents=True)
    (rooms_copy / "photos" / "thumbnails" / "kitchen" / "mine.jpg").write_bytes(b"mine")
    photos = Library.create(rooms_copy / "photos")
    photos.add(rooms_copy / "kitchen")
    (photos.stage / "notes.removed").write_bytes(b"mine")
    (photos.stage / "old.removed").mkdir()
    photos.remove("kitchen")
    photos.add(rooms_copy / "office")
    assert (rooms_copy / "photos" / "thumbnails" / "kitchen" / "mine.jpg").read_bytes() == b"mine"
    assert (photos.stage / "notes.removed").read_bytes() == b"mine"
    assert (photos.stage / "old.removed").is_dir()
    (rooms_copy / "songs").mkdir()
    (rooms_copy / "songs" / "library.json").write_text('{"songs": []}')
    for text in (
        '{"songs": []}',
        '{"format_version": 1, "name": "abc"}',
        '["\\ud800"]',
        "[" * 600 + "]" * 600,
    ):
        (rooms_copy / "songs" / "library.json").write_text(text)
        with pytest.raises(LibraryError, match=r"library\.json: expected .* give another folder"):
            Library.create(rooms_copy / "songs")
        assert (rooms_copy / "songs" / "library.json").read_text() == text


def test_every_changed_byte_of_the_library_file_is_harmless_or_corrected(rooms_copy):
    path = rooms_copy / "library" / "library.json"
    whole = path.read_bytes()
    for place in range(len(whole)):
        for bit in (1, 4, 64):
            path.write_bytes(whole[:place] + bytes([whole[place] ^ bit]) + whole[place + 1 :])
            told = ""
            try:
                Library(rooms_copy / "library")
            except LibraryError as error:
                told = str(error)
            assert not told or "--repair" in told
            assert len(Library.create(rooms_copy / "library").names()) == 3


def test_many_rebuilt_scenes_leave_room_for_the_others(rooms_copy):
    for number in range(5):
        write_scene(rooms_copy / f"room{number}", OTHERS)
    library = Library(rooms_copy / "library")
    for number in range(5):
        library.add(rooms_copy / f"room{number}")
        write_scene(rooms_copy / f"room{number}", OTHERS, build=2)
    found = library.search("vase", limit=1)  # four scenes are looked at, two of them rebuilt ones
    assert [hit.scene for hit in found.hits] == ["kitchen"]
    assert len(found.rebuilt) == 5


@pytest.mark.parametrize("text", [None, "", "{"])
def test_a_lost_library_file_is_written_again(rooms_copy, text):
    path = rooms_copy / "library" / "library.json"
    path.unlink() if text is None else path.write_text(text)
    with pytest.raises(LibraryError, match=f"lexsplat library verify {rooms_copy / 'library'} --repair"):
        Library(rooms_copy / "library")
    library = Library.create(rooms_copy / "library")
    assert library.verify(repair=True) == {}
    assert sorted(hits(library, "mug")) == ["kitchen", "lab"]


@pytest.mark.parametrize("left", [".lock", ".library.json.99999999.140.tmp"])
def test_a_first_addition_that_was_killed_goes_on(rooms_copy, left):
    (rooms_copy / "new").mkdir()
    (rooms_copy / "new" / left).touch()
    Library.create(rooms_copy / "new").add(rooms_copy / "kitchen")
    assert sorted(path.name for path in (rooms_copy / "new").iterdir() if path.name[0] != ".") == [
        "library.json", "scenes", "texts",
    ]  # fmt: skip


def test_an_addition_that_was_killed_after_its_first_file_goes_on_under_the_same_name(
    rooms_copy, monkeypatch
):
    scene = write_scene(rooms_copy / "hall", OTHERS, segments=True)
    library = Library.create(rooms_copy / "new")

    def killed_before_the_codes(path, *rest):
        if not path.name.endswith(".objects.safetensors"):
            raise KeyboardInterrupt
        write_tensors(path, *rest)

    with monkeypatch.context() as patch:
        patch.setattr("lexsplat.scenes.library.entries.write_tensors", killed_before_the_codes)
        with pytest.raises(KeyboardInterrupt):
            library.add(scene)
    (left,) = library.stage.glob("hall.*")
    assert left.name.endswith(".objects.safetensors")
    assert Library(rooms_copy / "new").verify() == {}
    other = Library(rooms_copy / "new")
    assert other.add(rooms_copy / "lab").name == "lab"
    assert not left.exists()
    left.touch()
    assert other.add(scene).name == "hall"


@pytest.mark.parametrize(
    "change", [{"content": "../x"}, {"encoder": "a/b"}, {"codes": -1}, {"codes": "many"}]
)
def test_a_record_with_values_that_no_library_writes_is_refused(rooms_copy, change):
    path = rooms_copy / "library" / "scenes" / "kitchen.json"
    write_record(dataclasses.replace(read_record(path), **change), path)
    library = Library(rooms_copy / "library")
    assert library.record("kitchen") is None
    assert isinstance(library.damaged["kitchen"], FileFormatError)


def test_every_field_of_a_record_is_kept_twice(rooms):
    """The copy in the codes is what a damaged record is recovered from."""
    from lexsplat.runtime.files import read_tensors

    record = Library(rooms / "library").record("kitchen")
    _, header = read_tensors(rooms / "library" / "scenes" / record.codes_file)
    assert (
        json.loads(header["record"])
        == record.sealed()
        == read_json(rooms / "library" / "scenes" / "kitchen.json")
    )


def test_damaged_codes_stay_reported_while_other_questions_read_the_record(rooms_copy):
    """The record is whole: who reads it says nothing about the codes, which another thread has found damaged."""
    (file,) = (rooms_copy / "library" / "scenes").glob("kitchen.*.safetensors")
    damage(file)
    library = Library(rooms_copy / "library")
    assert library.codes(library.record("kitchen")) is None
    library.record("kitchen"), library.records()  # as the question of another thread does
    assert "damaged" in str(library.damaged["kitchen"])
    damage(file)  # the same bit once more
    assert library.codes(library.record("kitchen")) is not None
    assert library.damaged == {}


def test_damaged_codes_are_no_longer_reported_once_the_scene_is_added_again(rooms_copy):
    (file,) = (rooms_copy / "library" / "scenes").glob("kitchen.*.safetensors")
    damage(file)
    library = Library(rooms_copy / "library")
    assert library.codes(library.record("kitchen")) is None
    Library(rooms_copy / "library").add(rooms_copy / "kitchen")
    library.record("kitchen")
    assert library.damaged == {}
