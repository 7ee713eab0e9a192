"""Published folders: what is in them, and what is refused. tests/scenes/test_published_page.py opens them."""

from __future__ import annotations

import json
import shutil
import subprocess
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from support.viewer_scene import ball_scene

from lexsplat.runtime.errors import QueryError, SceneFolderError
from lexsplat.runtime.files import write_json
from lexsplat.scenes import publishing
from lexsplat.scenes.folder import SceneFolder
from lexsplat.scenes.formats.language import stored_language
from lexsplat.scenes.formats.reading import read_splats
from lexsplat.scenes.formats.sog import read_sog
from lexsplat.scenes.publishing import PublishOptions, publish, sidecar, splat_file, vocabulary
from lexsplat.scenes.publishing.manifest import FORMAT

pytestmark = pytest.mark.slow

WEB = Path(__file__).parents[2] / "web"
BUNDLE = Path(publishing.__file__).parent / "page"


@pytest.fixture(scope="module")
def scene_of_balls():
    return ball_scene()[0]


@pytest.fixture
def small_dictionary(monkeypatch):
    monkeypatch.setattr(
        vocabulary, "everyday_phrases", lambda bundled: dict.fromkeys(["ball 1", "chair"], "n")
    )


def published(scene, folder, **options) -> dict:
    publish(scene, folder, PublishOptions(**options))
    return json.loads((folder / "manifest.json").read_text())


def test_there_are_five_thousand_everyday_phrases_without_repetition():
    phrases = list(vocabulary.everyday_phrases())
    assert len(phrases) > 5000
    assert all(phrase == " ".join(phrase.split()).lower() for phrase in phrases)


def test_the_codes_of_the_page_give_the_scores_of_the_field(scene_of_balls):
    generator = torch.Generator().manual_seed(0)
    weights = torch.rand(500, 4, generator=generator).sort(1, descending=True).values
    weights /= weights.sum(1, keepdim=True)
    weights[:50] = 0  # seen by no view
    language = stored_language(scene_of_balls.field, {}).select(torch.arange(500))
    exact = type(language)(language.codes, weights, language.uncertainties, language.codewords, {})
    content = np.frombuffer(sidecar.splat_codes(exact), np.uint8).reshape(2, 500, 4)
    shares = content[1].astype(float) / 255 / [1, 2, 3, 4]
    shares[:, 0] -= shares[:, 1:].sum(1)
    assert np.array_equal(content[0], language.codes.numpy())
    # Scores of the worst table, which has 0 and 1 only, differ by the sum of errors of one sign.
    errors = shares - weights.numpy()
    assert np.maximum(errors, 0).sum(1).max() <= 0.55 / 255
    assert np.maximum(-errors, 0).sum(1).max() <= 0.55 / 255


def test_the_manifest_lists_every_file_with_its_checksum(scene_of_balls, tmp_path, small_dictionary):
    manifest = published(scene_of_balls, tmp_path / "page", words_only=True, title="Balls")
    files = {path.name for path in (tmp_path / "page").iterdir()} - {"manifest.json", "index.html"}
    assert files == set(manifest["files"]) - {"index.html"}
    for name in files:
        content = (tmp_path / "page" / name).read_bytes()
        assert manifest["files"][name]["bytes"] == len(content)
        assert manifest["files"][name]["crc32"] == zlib.crc32(content)
    assert manifest["text"] is None
    assert (
        manifest["words"]["count"] * manifest["language"]["num_codes"]
        == manifest["files"]["words.bin"]["bytes"]
    )


def test_progress_counts_the_parts_of_the_page(scene_of_balls, tmp_path, small_dictionary, monkeypatch):
    events = []
    monkeypatch.setattr(scene_of_balls, "listener", events.append)
    published(scene_of_balls, tmp_path / "page", words_only=True)
    steps = [(event.done, event.total) for event in events if event.stage == "page"]
    assert steps == [(done, 6) for done in range(7)]


def test_the_splats_are_an_spz_in_the_order_of_the_codes(scene_of_balls, tmp_path, monkeypatch):
    monkeypatch.setattr(splat_file, "SMALL_BYTES", 0)
    path, rotation = splat_file.write_splats(scene_of_balls.gaussians, tmp_path)
    assert (path.name, rotation) == ("scene.spz", (1, 0, 0, 0))
    assert path.read_bytes()[:2] == b"\x1f\x8b", "the page's renderer reads gzip, not version 4"
    assert np.allclose(read_splats(path).means, scene_of_balls.gaussians.means, atol=1e-4)


def test_small_scenes_are_a_ply_without_loss_and_large_ones_the_smaller_of_spz_and_sog(
    scene_of_balls, tmp_path, monkeypatch
):
    path, rotation = splat_file.write_splats(scene_of_balls.gaussians, tmp_path, shrink=True)
    assert (path.name, rotation) == ("scene.ply", (0, 0, 0, 1))
    assert torch.equal(read_splats(path).means, scene_of_balls.gaussians.means)
    path.unlink()
    monkeypatch.setattr(splat_file, "SMALL_BYTES", 0)
    monkeypatch.setattr(splat_file, "LARGE_BYTES", 0)
    gaussians = scene_of_balls.gaussians.map(torch.clone)
    gaussians.shN = torch.randn(len(gaussians), 15, 3, generator=torch.Generator().manual_seed(0))
    sizes = {}
    for shrink in (False, True):
        path, _ = splat_file.write_splats(gaussians, tmp_path, shrink)
        sizes[path.suffix] = path.stat().st_size
        assert [file.name for file in tmp_path.iterdir()] == [path.name]
        assert np.allclose(read_splats(path).means, gaussians.means, atol=1e-3)
        path.unlink()
    assert sizes[".spz"] >= min(sizes.values())


@pytest.mark.parametrize("far", [1e6, 1e8])
def test_one_far_gaussian_does_not_make_the_others_coarse(scene_of_balls, tmp_path, monkeypatch, far):
    monkeypatch.setattr(splat_file, "SMALL_BYTES", 0)
    gaussians = scene_of_balls.gaussians.map(torch.clone)
    gaussians.means[7, 0] = far
    path, _ = splat_file.write_splats(gaussians, tmp_path)
    found = read_sog(path).means  # read as splats of others, one at 1e8 would be dropped with a warning
    others = torch.arange(len(gaussians)) != 7
    assert (found - gaussians.means)[others].abs().max() < 0.1 * gaussians.scales.median()
    assert found[7, 0] == pytest.approx(far, rel=1e-2)


def test_max_splats_keeps_those_that_cover_most_in_their_order(scene_of_balls, tmp_path, small_dictionary):
    gaussians = scene_of_balls.gaussians.map(torch.clone)
    gaussians.log_scales[1::2] -= 3
    thinned = type(scene_of_balls)(gaussians, scene_of_balls.field, scene_of_balls.views, scene_of_balls.clip)
    half = (len(gaussians) + 1) // 2
    assert splat_file.most_visible(gaussians, half).tolist() == list(range(0, len(gaussians), 2))
    manifest = published(thinned, tmp_path / "page", words_only=True, max_splats=half)
    assert (manifest["scene"]["gaussians"], manifest["scene"]["of"]) == (half, len(gaussians))
    assert manifest["files"]["codes.bin"]["bytes"] == 8 * half


def test_publishing_again_replaces_the_page_and_keeps_no_file_of_before(
    scene_of_balls, tmp_path, small_dictionary, monkeypatch
):
    folder = tmp_path / "page"
    published(scene_of_balls, folder, words_only=True)
    monkeypatch.setattr(splat_file, "NAME", "other")
    manifest = published(scene_of_balls, folder, words_only=True, title="again")
    assert {path.name for path in folder.iterdir()} == set(manifest["files"]) | {"manifest.json"}
    assert not (folder / "scene.ply").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["page"]


def test_what_was_asked_in_the_viewer_comes_first_as_plain_text(scene_of_balls, tmp_path):
    write_json(tmp_path / "viewer.json", {"history": ["Blue\n<b>Ball</b>", "ball  2", 7, "x" * 300]})
    scene = scene_of_balls.with_content(scene_of_balls.gaussians, scene_of_balls.field)
    scene.folder = SceneFolder(tmp_path)
    phrases = vocabulary.page_phrases(vocabulary.asked_phrases(scene))
    assert list(phrases)[:2] == ["blue <b>ball</b>", "ball 2"]
    assert max(map(len, phrases)) <= 120
    lines = vocabulary.words_file(phrases, ["y"] * len(phrases)).decode().splitlines()
    assert lines[:2] == ["ayblue <b>ball</b>", "ayball 2"]
    assert len(lines) == len(phrases)


def test_phrases_from_the_viewer_are_noted_with_their_file_and_no_truncated_one_is_offered(
    scene_of_balls, tmp_path, monkeypatch, caplog
):
    write_json(tmp_path / "viewer.json", {"history": ["blue lamp", "x" * 80, "mug left of the duck", "cup"]})
    scene = scene_of_balls
    monkeypatch.setattr(scene, "folder", SceneFolder(tmp_path))
    monkeypatch.setattr(type(scene), "tokens_over", lambda _, text: max(len(text) - 77, 0), raising=False)
    with caplog.at_level("INFO", logger="lexsplat"):
        phrases = vocabulary.offered_phrases(scene)
    assert [phrase for phrase, kind in phrases.items() if kind == vocabulary.ASKED] == ["blue lamp", "cup"]
    told = "2 phrases are offered to visitors, and 1 left out that the encoder would truncate"
    assert caplog.messages == [f"{tmp_path / 'viewer.json'}: {told}"]
    (tmp_path / "viewer.json").unlink()
    vocabulary.offered_phrases(scene)
    assert len(caplog.messages) == 1, "nothing was asked"


def test_only_things_that_were_asked_for_are_in_the_dictionary_as_a_table_answers_no_relations():
    asked = [
        "mug left of the duck",
        "red mug",
        "the biggest toy",
        "why is the mug so red",
        'mug "',
        "where is the lamp?",
    ]
    of_scene = [phrase for phrase, kind in vocabulary.page_phrases(asked).items() if kind == vocabulary.ASKED]
    assert of_scene == ["red mug", "where is the lamp?"]


@pytest.mark.parametrize(
    ("make", "found"),
    [
        (lambda folder: (folder / "holiday.jpg").write_text("mine"), "holiday.jpg"),
        (
            lambda folder: (folder / "manifest.json").write_text('{"name": "another program"}'),
            "manifest.json",
        ),
    ],
)
def test_a_folder_with_files_of_others_is_refused_and_left_alone(scene_of_balls, tmp_path, make, found):
    make(tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(SceneFolderError, match=found):
        publish(scene_of_balls, tmp_path)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize("files", [{"../mine.txt": {}}, {"..": {}}, [["scene.spz"]], 7])
def test_a_manifest_that_names_files_outside_its_folder_is_not_an_earlier_page(
    scene_of_balls, tmp_path, files
):
    (tmp_path / "mine.txt").write_text("mine")
    folder = tmp_path / "page"
    folder.mkdir()
    write_json(folder / "manifest.json", {"format": FORMAT, "files": files})
    with pytest.raises(SceneFolderError, match=r"foreign files: manifest\.json"):
        publish(scene_of_balls, folder, PublishOptions(words_only=True))
    assert (tmp_path / "mine.txt").read_text() == "mine"


def test_a_folder_that_has_the_name_of_a_file_of_the_page_is_refused(scene_of_balls, tmp_path):
    write_json(tmp_path / "manifest.json", {"format": FORMAT, "files": {"page.js": {}}})
    (tmp_path / "page.js").mkdir()
    with pytest.raises(SceneFolderError, match=r"foreign files: page\.js"):
        publish(scene_of_balls, tmp_path, PublishOptions(words_only=True))
    assert (tmp_path / "page.js").is_dir()


def test_single_files_need_a_name_in_html_and_replace_no_other_file(scene_of_balls, tmp_path):
    single = PublishOptions(single_file=True)
    with pytest.raises(SceneFolderError, match=r"\.html"):
        publish(scene_of_balls, tmp_path / "page", single)
    (tmp_path / "mine.html").write_text("<p>mine</p>")
    with pytest.raises(SceneFolderError, match="another file"):
        publish(scene_of_balls, tmp_path / "mine.html", single)


def test_a_single_file_that_would_be_too_large_is_refused(
    scene_of_balls, tmp_path, small_dictionary, monkeypatch
):
    monkeypatch.setattr("lexsplat.scenes.publishing.writing.SINGLE_FILE_BYTES", 1000)
    with pytest.raises(SceneFolderError, match="for a single file"):
        publish(scene_of_balls, tmp_path / "page.html", PublishOptions(single_file=True, words_only=True))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("count", [0, 1])
def test_a_scene_of_no_or_one_gaussian_is_refused(scene_of_balls, tmp_path, count):
    few = scene_of_balls.with_content(
        scene_of_balls.gaussians.select(torch.arange(count)), scene_of_balls.field.select(torch.arange(count))
    )
    with pytest.raises(QueryError, match=f"at least 2 Gaussians, found {count}"):
        publish(few, tmp_path / "page")
    assert not list(tmp_path.iterdir())


def test_a_scene_with_nan_and_one_too_large_are_refused(scene_of_balls, tmp_path, monkeypatch):
    gaussians = scene_of_balls.gaussians.map(torch.clone)
    gaussians.means[3] = torch.nan
    with pytest.raises(QueryError, match="NaN or Inf in means"):
        publish(scene_of_balls.with_content(gaussians, scene_of_balls.field), tmp_path / "page")
    monkeypatch.setattr("lexsplat.scenes.publishing.writing.MOST_SPLATS", 100)
    with pytest.raises(QueryError, match="--max-splats"):
        publish(scene_of_balls, tmp_path / "page")
    assert not list(tmp_path.iterdir())


def test_an_unknown_start_view_is_refused(scene_of_balls, tmp_path):
    with pytest.raises(QueryError, match="view 'nowhere'"):
        publish(scene_of_balls, tmp_path / "page", PublishOptions(start_view="nowhere"))
    assert not list(tmp_path.iterdir())


def test_a_scene_without_language_is_refused_in_one_line(tmp_path, capsys):
    from lexsplat import cli
    from lexsplat.scenes.folder import BUNDLED_SCENE

    for name in ("scene.json", "cameras.json", "gaussians.ply"):
        shutil.copyfile(BUNDLED_SCENE / name, tmp_path / name)
    assert cli.main(["publish", str(tmp_path), str(tmp_path / "page")]) == 1
    line = capsys.readouterr().err
    assert line.startswith("error: ")
    assert "language" in line
    assert line.count("\n") == 1
    assert not (tmp_path / "page").exists()


def _npx(*arguments: str) -> str:
    if shutil.which("node") is None or not (WEB / "node_modules").is_dir():
        pytest.skip("needs node and: npm ci --prefix web")
    done = subprocess.run(arguments, cwd=WEB, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_bundle_is_what_its_source_gives(tmp_path):
    _npx("node", "build.mjs", str(tmp_path))
    for path in tmp_path.iterdir():
        assert path.read_bytes() == (BUNDLE / path.name).read_bytes(), path.name


def test_the_source_of_the_page_passes_the_type_checker_and_the_linter():
    _npx("npm", "run", "--silent", "check")


def test_the_code_of_the_page_is_at_most_1_4_megabytes_compressed():
    sizes = [
        len(zlib.compress((BUNDLE / name).read_bytes(), 9)) for name in ("page.js", "page.wasm", "page.css")
    ]
    assert sum(sizes) < 1.4e6
