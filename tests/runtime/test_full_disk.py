"""A full disk: one line, exit status 1, the last good state as it was, and the build goes on when there is room."""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
import resource
import shutil
import signal
import subprocess
from pathlib import Path

import pytest

from lexsplat import cli
from lexsplat.scenes.scene import open_scene

pytestmark = pytest.mark.slow


@pytest.fixture
def small_disk(tmp_path):
    """A file system in memory with room for 600 kB."""
    place = tmp_path / "disk"
    place.mkdir()
    if os.geteuid() != 0:
        pytest.skip("only root may mount a small file system")
    made = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=600k", "tmpfs", str(place)], capture_output=True
    )
    if made.returncode:
        pytest.skip("mounting is not allowed here")
    yield place
    subprocess.run(["umount", "-l", str(place)], check=True)


def run(*arguments: str) -> subprocess.CompletedProcess:
    """The command line in this process, as `subprocess.run` would tell it."""
    output, errors = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(errors):
        status = cli.main([*arguments])
    return subprocess.CompletedProcess(arguments, status, output.getvalue(), errors.getvalue())


def build_arguments(capture: Path, output: Path) -> list[str]:
    return [
        "build", str(capture), "--output", str(output), "--clip", "bundled", "--dino", "none", "--device", "cpu",
        "--iterations", "6", "--downscale", "2", "--reconstruction.max-gaussians", "1300",
        "--codebook.num-codes", "8", "--codebook.steps", "5", "--features.crop-sizes", "0.5",
        "--features.crop-strides", "0.5", "--features.map-cells", "16",
        # What is written must not depend on how busy the machine is: no savings by the clock.
        "--checkpoint-seconds", "1e6",
    ]  # fmt: skip


def assert_one_line(done: subprocess.CompletedProcess) -> None:
    """What people see of a command that could not write."""
    assert done.returncode == 1, done.stderr[-2000:]
    assert "Traceback" not in done.stderr
    errors = [line for line in done.stderr.splitlines() if "error: " in line]
    assert len(errors) == 1, done.stderr[-2000:]
    assert any(words in errors[0] for words in ("No space left", "File too large", "space")), errors[0]


def content(folder: Path) -> dict[str, str]:
    """Hashes of all files of a folder."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file() and path.name != ".lock")
    return {str(path.relative_to(folder)): hashlib.blake2b(path.read_bytes()).hexdigest() for path in files}


def no_left_overs(folder: Path) -> bool:
    return not list(folder.rglob(".*.tmp"))


def test_a_build_on_a_full_disk_ends_in_one_line_and_goes_on_when_there_is_room(
    tiny_capture, small_disk, tmp_path
):
    ballast = small_disk / "ballast"
    ballast.write_bytes(b"\0" * 560_000)
    arguments = build_arguments(tiny_capture, small_disk / "scene")
    assert_one_line(run(*arguments))
    assert no_left_overs(small_disk / "scene")
    ballast.unlink()  # 600 kB are still not enough for everything: further on it is full again, or done
    second = run(*arguments)
    if second.returncode:
        assert_one_line(second)
    shutil.move(small_disk / "scene", tmp_path / "scene")
    assert run(*build_arguments(tiny_capture, tmp_path / "scene")).returncode == 0
    assert len(open_scene(tmp_path / "scene", device="cpu").gaussians) > 0


def test_a_scene_on_a_full_disk_stays_as_it_was(built, small_disk, tmp_path):
    scene = tmp_path / "scene"
    shutil.copytree(built, scene)
    before = content(scene)
    (small_disk / "ballast").write_bytes(b"\0" * 590_000)
    exported = run("export", str(scene), str(small_disk / "scene.ply"))
    assert_one_line(exported)
    assert f"error: {small_disk / 'scene.ply'}: No space left" in exported.stderr
    assert not (small_disk / "scene.ply").exists()
    assert content(scene) == before
    open_scene(scene, device="cpu")


@pytest.fixture
def run_limited():
    """Runs the command line so that no file can become larger than so many bytes: a full disk without a mount."""
    if not hasattr(resource, "RLIMIT_FSIZE") or not hasattr(signal, "SIGXFSZ"):
        pytest.skip("no limit of file sizes on this system")

    before = resource.getrlimit(resource.RLIMIT_FSIZE)

    def command(size: int, *arguments: str) -> subprocess.CompletedProcess:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
        try:
            return run(*arguments)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)

    # A write beyond the limit is an error instead of the end.
    told = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    yield command
    signal.signal(signal.SIGXFSZ, told)


@pytest.mark.parametrize("size", [200, 3_000, 60_000])
def test_a_build_that_cannot_write_keeps_the_scene_that_was_there(
    built, tiny_capture, tmp_path, run_limited, size
):
    scene = tmp_path / "scene"
    shutil.copytree(built, scene)
    before = content(scene)
    done = run_limited(
        size, *build_arguments(tiny_capture, scene)
    )  # other settings: everything is to be done again
    assert_one_line(done)
    assert no_left_overs(scene)
    after = content(scene)
    changed = [name for name in before if after.get(name) != before[name]]
    # Whatever was written is whole; Gaussians and language were too large to be written at all.
    assert not {"gaussians.ply", "language.safetensors"} & set(changed) or size > 10_000
    again = run(*build_arguments(tiny_capture, scene))
    assert again.returncode == 0, again.stderr[-1000:]
    open_scene(scene, device="cpu")


def test_an_edit_and_an_export_that_cannot_write_leave_nothing_half_done(built, tmp_path, run_limited):
    before = content(built)
    for ending in ("ply", "splat", "glb"):
        done = run_limited(2_000, "export", str(built), str(tmp_path / f"out.{ending}"))
        assert_one_line(done)
        assert f"error: {tmp_path / 'out'}.{ending}: " in done.stderr, "the file that was asked for"
        assert not (tmp_path / f"out.{ending}").exists()
    published = run_limited(2_000, "publish", str(built), str(tmp_path / "page"), "--words-only")
    assert_one_line(published)
    assert f"error: {tmp_path / 'page'}: " in published.stderr
    scene = tmp_path / "scene"
    shutil.copytree(built, scene)
    assert run("edit", str(scene), "delete", "--select", "red apple", "--threshold", "0.01").returncode == 0
    before_save = content(scene)
    assert_one_line(run_limited(2_000, "edit", str(scene), "save", "--output", str(tmp_path / "edited")))
    assert content(scene) == before_save
    assert not (tmp_path / "edited").exists() or not (tmp_path / "edited" / "scene.json").exists()
    assert no_left_overs(tmp_path)
    assert content(built) == before
