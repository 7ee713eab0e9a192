"""What a scene keeps on disk for its first questions, and kinds that are answered alike everywhere."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from lexsplat.geometry.boxes import Up
from lexsplat.geometry.world import World
from lexsplat.queries.phrases import Thing, Understood
from lexsplat.queries.relevancy import QueryConfig
from lexsplat.rendering import render
from lexsplat.runtime.errors import ModelError
from lexsplat.runtime.progress import NOTE, Event
from lexsplat.scenes import kept as kept_files
from lexsplat.scenes.answers import answer_queries, find_phrase
from lexsplat.scenes.editing import Editor
from lexsplat.scenes.folder import BUNDLED_SCENE
from lexsplat.scenes.kept import keep, scene_key
from lexsplat.scenes.objects import list_document
from lexsplat.scenes.scene import Scene, open_scene
from lexsplat.scenes.serving import OpenScene, answer_line

SEEN = "checkpoints/seen.safetensors"
OBJECTS = "checkpoints/objects.safetensors"


@pytest.fixture(scope="module")
def demo() -> Scene:
    return open_scene("demo", device="cpu")


def test_the_bundled_scene_ships_what_its_views_show(demo):
    assert demo.seen.complete, (
        "run tools/demo_scene/ship.py, or lexsplat.scenes.kept.keep on the bundled scene"
    )


@pytest.mark.slow
@pytest.mark.parametrize("phrase", ["mug", "table lamp", "tablecloth"])
def test_the_share_of_a_view_is_that_of_a_rendering(demo, phrase):
    found = demo.select(phrase)
    for name, share in found.view_shares[:3]:
        camera = demo.cameras[name].downscaled(max(1.0, demo.cameras[name].width / 120))
        drawn = render(demo.gaussians, camera, features=found.mask[:, None].float(), color=False).features
        assert share == pytest.approx(float(drawn.mean()), rel=0.15)


@pytest.fixture
def demo_copy(tmp_path):
    folder = tmp_path / "scene"
    shutil.copytree(BUNDLED_SCENE, folder)
    return folder


@pytest.mark.slow
def test_what_is_kept_is_what_is_computed_without_it(demo_copy, demo):
    (demo_copy / SEEN).unlink()
    scene = open_scene(demo_copy, device="cpu")
    assert not scene.seen.complete
    assert torch.equal(scene.hidden, demo.hidden)
    assert scene.select("mug").best_view == demo.select("mug").best_view
    keep(scene)
    again = open_scene(demo_copy, device="cpu")
    assert again.seen.complete
    assert torch.equal(again.hidden, demo.hidden)
    assert again.select("mug").view_shares == demo.select("mug").view_shares


@pytest.mark.slow
def test_the_best_view_shows_a_thing_whole_where_one_that_cuts_it_shows_hardly_more(demo):
    bottle = next(thing for thing in demo.objects if thing.phrase == "bottle")

    def drawn(name: str) -> torch.Tensor:
        carried = bottle.mask[:, None].float()
        return render(demo.gaussians, demo.cameras[name], features=carried, color=False).features[..., 0]

    def at_border(image: torch.Tensor) -> float:
        return float(torch.cat([image[[0, -1]].flatten(), image[:, [0, -1]].flatten()]).max())

    images = {name: drawn(name) for name, _ in bottle.view_shares}
    most, best = max(images.values(), key=torch.sum), drawn(bottle.best_view)
    assert at_border(most) > 0.5, "the border cuts it in the view that shows most of it"
    assert at_border(best) < 0.05
    assert float(best.sum()) > 0.8 * float(most.sum())


@pytest.mark.slow
def test_what_the_first_questions_compute_is_counted(demo_copy, tmp_path):
    for name in (SEEN, OBJECTS):
        (demo_copy / name).unlink()
    scene, events = open_scene(demo_copy, device="cpu"), list[Event]()
    scene.listener = events.append

    def ends() -> dict[str, int]:
        counted = [event for event in events if event.stage != "rasterizer"]
        found = {event.stage: event.total for event in counted if event.done == event.total}
        assert all(event.stage in found for event in counted)
        events.clear()
        return found

    find_phrase(scene, "red apple")
    found = ends()
    assert found["objects"] > 10
    assert found["views"] == 2, "the best ones of all apples and of the only one"
    list_document(scene, picture=tmp_path / "sheet.png")
    assert ends() == dict.fromkeys(("views", "pictures"), len(scene.objects))


@pytest.mark.slow
def test_an_answer_does_not_depend_on_what_was_asked_before(demo_copy):
    (demo_copy / SEEN).unlink()
    phrase = "mug to the left of the apple"
    at_once, later = (open_scene(demo_copy, device="cpu") for _ in range(2))
    for name in later.views:
        later.seen._column(name)
    assert find_phrase(later, phrase) == find_phrase(at_once, phrase)
    keep(later)
    assert later.seen.complete


@pytest.mark.slow
def test_the_bundled_scene_ships_its_objects_as_they_are_found_without_the_file(demo_copy, demo):
    assert demo.kept is not None, (
        "run tools/demo_scene/ship.py, or lexsplat.scenes.kept.keep on the bundled scene"
    )
    (demo_copy / OBJECTS).unlink()
    scene = open_scene(demo_copy, device="cpu")
    assert scene.kept is None
    assert len(scene.objects) == len(demo.objects) > 10
    for found, kept in zip(scene.objects, demo.objects):
        assert (kept.phrase, [name for name, _ in kept.names]) == (
            found.phrase,
            [name for name, _ in found.names],
        )
        assert [share for _, share in kept.names] == pytest.approx(
            [share for _, share in found.names], rel=1e-4
        )
        assert torch.equal(kept.mask, found.mask)
        assert torch.equal(kept.indices, found.indices)
        assert kept.score == pytest.approx(found.score, rel=1e-4)
        for one, other in zip(kept.box, found.box):
            assert one == pytest.approx(other)
    places = scene.presence_classifier.places
    assert places.words == demo.kept.places.words
    assert torch.allclose(places.distributions, demo.kept.places.distributions, atol=1e-6)


def test_kept_objects_are_those_of_one_encoder_query_and_scene_or_none(demo_copy, demo):
    content = (demo_copy / OBJECTS).read_bytes()
    for damaged in (content[:1000], b"", content[:-1] + bytes([content[-1] ^ 1])):
        (demo_copy / OBJECTS).write_bytes(damaged)
        assert open_scene(demo_copy, device="cpu").kept is None
    (demo_copy / OBJECTS).write_bytes(content)
    scene = open_scene(demo_copy, device="cpu")
    assert scene.kept is not None
    scene.query = QueryConfig(temperature=5.0)
    assert scene.kept is None, "another query"
    scene.query = QueryConfig()
    scene.field.codes[0, 0] ^= 1
    scene.__dict__.pop("kept", None)
    assert scene.kept is None, "another language"
    some = torch.arange(len(demo.gaussians)) % 2 == 0
    assert demo.with_content(demo.gaussians.select(some), demo.field.select(some)).kept is None


def changed(tensor):
    tensor.view(-1)[0] = not tensor.view(-1)[0] if tensor.dtype == torch.bool else tensor.view(-1)[0] + 1


def test_the_key_of_a_scene_depends_on_everything_that_its_views_show(demo_copy):
    scene = open_scene(demo_copy, device="cpu")
    gaussians, segments = scene.gaussians, scene.field.segments
    keys = [scene_key(scene)]
    for tensor in (
        *(gaussians.means, gaussians.quats, gaussians.log_scales, gaussians.opacity_logits),
        *(segments.labels, segments.masses, segments.levels),
    ):
        changed(tensor)
        keys.append(scene_key(scene))
    gaussians.antialiased = not gaussians.antialiased
    keys.append(scene_key(scene))
    name, view = next(iter(scene.views.items()))
    camera = view.camera
    K, viewmat = camera.K.copy(), camera.viewmat.copy()
    K[0, 0] += 1
    viewmat[0, 3] += 1
    for other in (
        replace(view, split="test" if view.split == "train" else "train"),
        replace(view, camera=replace(camera, width=camera.width + 1)),
        replace(view, camera=replace(camera, height=camera.height + 1)),
        replace(view, camera=replace(camera, K=K)),
        replace(view, camera=replace(camera, viewmat=viewmat)),
    ):
        scene.views[name] = other
        keys.append(scene_key(scene))
    scene.views = {"another": scene.views.pop(name), **scene.views}
    keys.append(scene_key(scene))
    assert len(set(keys)) == len(keys) == 15


@pytest.mark.parametrize(
    "change",
    [
        lambda scene, _: changed(scene.field.codes),
        lambda scene, _: changed(scene.field.weights),
        lambda scene, _: changed(scene.field.codebook.clip),
        lambda scene, _: changed(scene.field.segments.levels),
        lambda scene, _: setattr(scene, "query", QueryConfig(templates=("a photo of {}",))),
        lambda scene, _: setattr(scene, "world", World(Up(np.array([0.0, 1.0, 0.0]), True))),
        lambda scene, _: scene.folder.record["stages"]["features"].update(clip_hash="another"),
        lambda _, patch: patch.setattr(kept_files, "everyday_words", lambda: ["one", "two"]),
        lambda _, patch: patch.setattr(kept_files, "default_vocabulary", lambda clip: ["one"]),
        lambda _, patch: patch.setattr(kept_files, "STUFF", {"one"}),
        lambda _, patch: patch.setattr(kept_files, "_OBJECTS_VERSION", -1),
    ],
    ids=[
        "codes",
        "weights",
        "codebook",
        "levels",
        "query",
        "up",
        "encoder",
        "words",
        "names",
        "stuff",
        "version",
    ],
)
def test_kept_objects_depend_on_everything_that_they_come_from(demo_copy, monkeypatch, change):
    assert open_scene(demo_copy, device="cpu").kept is not None
    scene = open_scene(demo_copy, device="cpu")
    change(scene, monkeypatch)
    assert scene.kept is None


def test_a_kept_answer_depends_on_what_was_understood_and_the_view_and_the_threshold(demo):
    phrases = {
        "as it is": Understood(Thing("mug")),
        "exact": Understood(Thing("mug", exact=True)),
        "not understood": Understood(Thing("mug"), unknown=True),
    }
    scene = demo.with_content(demo.gaussians, demo.field)
    for text, understood in phrases.items():
        scene._understood.put(text, understood)
    for text in (*phrases, *reversed(phrases)):
        assert scene.find(text).present == ("unsure" if text == "not understood" else "yes"), text
    one, other = (
        scene.find("mug left of the apple", "view_000"),
        scene.find("mug left of the apple", "view_036"),
    )
    assert one is not other
    assert scene.find("mug left of the apple", "view_000.jpg") is one
    assert scene.find("mug", threshold=0.75).threshold == 0.75
    assert scene.find("mug").threshold == 0.5


@pytest.mark.slow
def test_a_saved_edit_keeps_what_its_views_show(demo_copy, tmp_path):
    editor = Editor(open_scene(demo_copy, device="cpu"))
    editor.delete(editor.scene.find("mug"))
    editor.save(tmp_path / "saved")
    saved = open_scene(tmp_path / "saved", device="cpu")
    assert saved.seen.complete
    assert saved.kept is not None
    assert "mug" not in [each.phrase for each in saved.objects]


def test_a_damaged_file_or_one_of_another_scene_counts_as_none(demo_copy):
    content = (demo_copy / SEEN).read_bytes()
    for damaged in (content[:1000], b"", content[:-1] + bytes([content[-1] ^ 1])):
        (demo_copy / SEEN).write_bytes(damaged)
        assert not open_scene(demo_copy, device="cpu").seen.complete
    (demo_copy / SEEN).write_bytes(content)
    scene = open_scene(demo_copy, device="cpu")
    scene.gaussians.means[0, 0] += 1  # before it is asked
    assert not scene.seen.complete


@pytest.mark.slow
def test_a_full_disk_is_noted_where_a_missing_encoder_is_not(demo_copy, monkeypatch, caplog):
    def failing(error):
        def write(*_):
            raise error

        return write

    shutil.rmtree(demo_copy / "checkpoints")
    scene = open_scene(demo_copy, device="cpu")  # what it computes first, it need not compute again
    for error, told in (
        (OSError(28, "No space left on device"), True),
        (ModelError("model x", found="no such folder"), False),
    ):
        caplog.clear()
        monkeypatch.setattr("lexsplat.scenes.kept.write_tensors", failing(error))
        with caplog.at_level(NOTE):
            keep(scene)
        expected = "checkpoints: what the first questions need is not kept; they compute it (No space left on device)"
        assert [message.endswith(expected) for message in caplog.messages] == ([True] if told else [])


def test_edited_content_does_not_take_what_is_kept_of_the_scene(demo):
    some = torch.arange(len(demo.gaussians)) % 2 == 0
    assert not demo.with_content(demo.gaussians.select(some), demo.field.select(some)).seen.complete


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "count"), [("toy", 3), ("fruit", 2), ("musical instrument", 0)])
def test_a_kind_has_the_same_presence_and_count_however_it_is_asked(demo, kind, count):
    present = "yes" if count else "no"
    answers = demo.ask(kind)
    assert answers.presences == (present,)
    assert answers.to_dict()["answers"][0]["count"] == count
    assert (demo.select(kind).present, bool(demo.select(kind))) == (present, count > 0)
    assert demo.find(kind).present == present
    assert find_phrase(demo, kind)["count"] == count
    (queried,) = answer_queries(demo, kind, ["view_033"], None, None)["prompts"]
    assert (queried["present"], queried["gaussians"] > 0) == (present, count > 0)
    assert answer_line(OpenScene("demo", "cpu"), f"how many {kind}s are there?")["count"] == count


def test_the_members_of_a_kind_reach_its_threshold_and_nothing_else_does(demo):
    answers = demo.ask("toy")
    members = torch.stack(
        [each.mask for each in demo.objects if each.phrase in ("toy car", "teddy bear", "rubber duck")]
    )
    assert torch.equal(answers.scores[0] >= answers.thresholds[0], members.any(0))
