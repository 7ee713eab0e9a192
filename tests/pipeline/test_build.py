"""The builder: order of the stages, what is kept, what is redone for a changed setting, what each stage receives."""

from __future__ import annotations

import gc
import shutil
import weakref
from dataclasses import replace

import pytest
import torch
from support import color_encoder
from support.experiments import CONFIG

from lexsplat.language.methods import JOINT_METHODS, METHODS, MethodName
from lexsplat.language.methods.averaged import Averaged, AveragedConfig
from lexsplat.language.methods.trained import Trained, TrainedConfig
from lexsplat.pipeline import build as pipeline
from lexsplat.pipeline import geometry
from lexsplat.pipeline.build import STAGES, build
from lexsplat.runtime.files import read_tensors
from lexsplat.runtime.memory import parse_bytes
from lexsplat.scenes.folder import SceneFolder
from lexsplat.scenes.scene import open_scene

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("color_encoders")]

AVERAGED = replace(CONFIG, method="averaged", iterations=4)
TRAINED = replace(CONFIG, iterations=4)


@pytest.fixture(scope="module")
def built_by_method(six_views, tmp_path_factory):
    """A scene by each method; its files must not be changed."""
    folder = tmp_path_factory.mktemp("scenes")
    for config in (AVERAGED, TRAINED):
        build(six_views, folder / config.method, config)
    return folder


def stages_run(capture, scene, config, **options) -> dict[str, bool]:
    """Names of the stages in the order in which they finish, and whether they were kept."""
    finished: dict[str, bool] = {}
    finish = SceneFolder.finish

    def listen(event):
        if "kept" in event.metrics:
            finished[event.stage] = True

    def record(folder, name, *arguments, **facts):
        finished[name] = False
        return finish(folder, name, *arguments, **facts)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SceneFolder, "finish", record)
        build(capture, scene, config, listener=listen, **options)
    return finished


def test_every_method_has_a_name_that_settings_accept_and_stages_that_exist():
    from typing import get_args

    assert set(get_args(MethodName)) == set(METHODS)
    for name, method in (*METHODS.items(), *JOINT_METHODS.items()):
        assert method.name == name
        assert set(method.needs) <= set(STAGES)
        assert set(method.stages) == {"reconstruct", *method.needs, "language"}
        assert method.variants["full"] == {}
        for part in (*method.settings, *(part for changes in method.variants.values() for part in changes)):
            assert hasattr(CONFIG, part), part


@pytest.mark.parametrize("config", [AVERAGED, TRAINED], ids=lambda config: config.method)
def test_stages_are_those_of_the_method_and_a_second_build_keeps_all(
    built_by_method, six_views, tmp_path, config
):
    expected = ["reconstruct", *METHODS[config.method].needs, "language"]
    record = SceneFolder.open(built_by_method / config.method).record
    assert list(record["stages"]) == expected
    assert record["stages"]["language"]["method"] == config.method
    copy = shutil.copytree(built_by_method / config.method, tmp_path / "copy")
    assert stages_run(six_views, copy, config) == dict.fromkeys(expected, True)


def test_a_scene_names_the_method_that_made_it_whatever_its_field_says(
    built_by_method, six_views, tmp_path, monkeypatch
):
    class Toy(Averaged):
        name = "toy"

    monkeypatch.setitem(METHODS, "toy", Toy())
    copy = shutil.copytree(built_by_method / "averaged", tmp_path / "copy")
    build(six_views, copy, replace(AVERAGED, method="toy"))
    scene = open_scene(copy, device="cpu")
    assert scene.field.method == scene.folder.record["stages"]["language"]["method"] == "toy"


@pytest.mark.parametrize(
    ("base", "change", "redone"),
    [
        (AVERAGED, {"averaged": AveragedConfig(top=3)}, {"language"}),
        (AVERAGED, {"codebook": replace(CONFIG.codebook, num_codes=5)}, {"language"}),
        (AVERAGED, {"trained": TrainedConfig(iterations=3)}, set()),
        (AVERAGED, {"memory": "1GB", "checkpoint_seconds": 0.0}, set()),
        (AVERAGED, {"dino": "none"}, {"features", "language"}),
        (AVERAGED, {"iterations": 5}, {"reconstruct", "features", "language"}),  # Gaussians choose the views
        (AVERAGED, {"averaged": AveragedConfig(sightings=0)}, {"features", "language"}),
        (TRAINED, {"averaged": AveragedConfig(top=3)}, set()),
        (TRAINED, {"trained": replace(CONFIG.trained, iterations=3)}, {"language"}),
        (TRAINED, {"codebook": replace(CONFIG.codebook, num_codes=5)}, {"codebook", "language"}),
        (TRAINED, {"features": replace(CONFIG.features, map_cells=16)}, {"features", "codebook", "language"}),
        (TRAINED, {"seed": 1}, {"reconstruct", "codebook", "language"}),
    ],
)
def test_a_changed_setting_redoes_what_depends_on_it(
    built_by_method, six_views, tmp_path, base, change, redone
):
    copy = shutil.copytree(built_by_method / base.method, tmp_path / "copy")
    finished = stages_run(six_views, copy, replace(base, **change))
    assert {name for name, kept in finished.items() if not kept} == redone


def test_features_are_made_of_the_chosen_photos_and_later_of_the_others(six_views, tmp_path, monkeypatch):
    def first_three(gaussians, views, *_):
        return sorted(views)[:3], torch.full((len(gaussians),), 0.75)

    monkeypatch.setattr("lexsplat.language.methods.averaged.views_that_show", first_three)

    def photos_with_features(sightings):
        config = replace(AVERAGED, averaged=AveragedConfig(sightings=sightings))
        folder = build(six_views, tmp_path / "scene", config)
        stored = len(list(folder.features_path.glob("*.clip.safetensors")))
        facts = folder.record["stages"]["features"]
        return facts["views"], facts["of"], stored

    assert photos_with_features(1) == (3, 4, 3)
    assert photos_with_features(0) == (4, 4, 4)


def test_a_choice_of_photos_is_kept_as_long_as_the_gaussians(
    built_by_method, six_views, tmp_path, monkeypatch, caplog
):
    copy = shutil.copytree(built_by_method / "averaged", tmp_path / "copy")
    choices = []

    def first_three(gaussians, views, *_):
        choices.append(len(gaussians))
        return sorted(views)[:3], torch.full((len(gaussians),), 0.75)

    monkeypatch.setattr("lexsplat.language.methods.averaged.views_that_show", first_three)
    other = replace(AVERAGED, averaged=AveragedConfig(top=3))
    assert stages_run(six_views, copy, other) == {"reconstruct": True, "features": True, "language": False}
    assert choices == [], "the stage features is finished"
    (copy / "checkpoints" / "views_to_read.safetensors").unlink()
    assert not stages_run(six_views, copy, other)["features"]
    assert len(choices) == 1
    make_other_gaussians(monkeypatch)
    (copy / "gaussians.ply").unlink()
    finished = stages_run(six_views, copy, other)
    assert finished == dict.fromkeys(finished, False)
    assert len(choices) == 2
    assert choices[1] < choices[0]


@pytest.mark.parametrize(("cached", "told"), [(True, 0), (False, 4)])
def test_no_time_is_told_beforehand_for_photos_whose_features_may_be_there(
    built_by_method, six_views, tmp_path, monkeypatch, cached, told
):
    copy = shutil.copytree(built_by_method / "averaged", tmp_path / "copy")
    if not cached:
        shutil.rmtree(SceneFolder.open(copy).features_path)
    counts, check = [], pipeline.check_encoders

    def counted(config, source, photos, *arguments):
        counts.append(photos)
        return check(config, source, photos, *arguments)

    monkeypatch.setattr(pipeline, "check_encoders", counted)
    build(six_views, copy, replace(AVERAGED, averaged=AveragedConfig(sightings=0)))
    assert counts == [told]


def make_other_gaussians(monkeypatch):
    """One fewer, as of a GPU whose sums are in another order."""
    write = SceneFolder.write_gaussians
    monkeypatch.setattr(
        SceneFolder,
        "write_gaussians",
        lambda self, made: write(self, made.select(torch.arange(1, len(made)))),
    )


def test_gaussians_made_for_another_method_have_a_choice_of_their_own(
    built_by_method, six_views, tmp_path, monkeypatch
):
    copy = shutil.copytree(built_by_method / "averaged", tmp_path / "copy")
    choice = copy / "checkpoints" / "views_to_read.safetensors"
    make_other_gaussians(monkeypatch)
    (copy / "gaussians.ply").unlink()
    assert stages_run(six_views, copy, TRAINED, until="reconstruct") == {"reconstruct": False}
    before = read_tensors(choice)[0]["shares"]
    build(six_views, copy, AVERAGED)
    assert len(read_tensors(choice)[0]["shares"]) == len(before) - 1


def test_a_missing_result_is_made_again(built_by_method, six_views, tmp_path):
    copy = shutil.copytree(built_by_method / "averaged", tmp_path / "copy")
    (copy / "language.safetensors").unlink()
    finished = stages_run(six_views, copy, AVERAGED)
    assert finished == {"reconstruct": True, "features": True, "language": False}
    for name in ("gaussians.ply", "language.safetensors"):
        assert (copy / name).read_bytes()[-500:] == (built_by_method / "averaged" / name).read_bytes()[-500:]


def test_a_build_stops_after_the_stage_asked_for(six_views, tmp_path):
    folder = build(six_views, tmp_path / "scene", AVERAGED, until="codebook")
    assert list(folder.record["stages"]) == ["reconstruct", "features"], "this method has no codebook stage"
    with pytest.raises(ValueError, match="until must be one of reconstruct"):
        build(six_views, tmp_path / "other", AVERAGED, until="embed")
    assert not (tmp_path / "other").exists()


def test_joint_training_makes_features_and_codes_before_the_geometry(six_views, tmp_path):
    joint = replace(TRAINED, joint=True)
    finished = stages_run(six_views, tmp_path / "scene", joint)
    assert list(finished) == ["features", "codebook", "reconstruct", "language"]
    record = SceneFolder.open(tmp_path / "scene").record["stages"]
    assert (record["language"]["method"], record["reconstruct"]["joint"]) == ("trained", True)
    assert stages_run(six_views, tmp_path / "scene", joint) == dict.fromkeys(finished, True)
    changed = replace(joint, trained=replace(CONFIG.trained, iterations=3))
    assert not stages_run(six_views, tmp_path / "scene", changed)["reconstruct"]
    with pytest.raises(ValueError, match="leave --splats out"):
        build(six_views, tmp_path / "other", joint, splats=tmp_path / "any.ply")


@pytest.fixture
def loaded(tmp_path, monkeypatch) -> list[str]:
    """What loads encoders appends its kind, with an empty cache of texts."""
    kinds: list[str] = []
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for place, kind, encoder in (
        ("features.encoders.load_clip", "clip", color_encoder.ColorClip),
        ("features.encoders.load_dino", "dino", color_encoder.ColorDino),
        ("scenes.scene.load_text", "text", color_encoder.ColorClip),
    ):
        monkeypatch.setattr(
            f"lexsplat.{place}", lambda *_, kind=kind, encoder=encoder: kinds.append(kind) or encoder()
        )
    return kinds


@pytest.mark.parametrize(
    ("config", "expected"),
    [
        (TRAINED, ["clip", "dino"]),
        (AVERAGED, ["clip", "dino"]),
        (replace(AVERAGED, averaged=AveragedConfig(dino=False)), ["clip"]),
    ],
    ids=["trained", "averaged from class tokens", "averaged without DINO"],
)
def test_a_build_loads_each_encoder_once_for_check_photos_and_texts(
    six_views, tmp_path, loaded, config, expected
):
    build(six_views, tmp_path / "scene", config)
    assert sorted(loaded) == expected
    kept = tmp_path / "scene" / "checkpoints" / "texts"
    assert list(kept.iterdir()), "texts were encoded"
    loaded.clear()
    build(six_views, tmp_path / "scene", config)
    assert loaded == [], "all results are there"


def test_new_settings_of_the_language_load_no_encoder_where_codes_are_kept(
    built_by_method, six_views, tmp_path, loaded
):
    copy = shutil.copytree(built_by_method / "trained", tmp_path / "copy")
    build(six_views, copy, replace(TRAINED, trained=TrainedConfig(iterations=2)))
    assert loaded == []


def test_the_encoder_of_photos_is_freed_before_the_language_is_made(six_views, tmp_path, monkeypatch):
    made, alive = [], []

    def load(*_):
        encoder = color_encoder.ColorDino()
        made.append(weakref.ref(encoder))
        return encoder

    def fit(self, *arguments, original=Trained.fit):
        gc.collect()
        alive.extend(each() for each in made)
        return original(self, *arguments)

    monkeypatch.setattr("lexsplat.features.encoders.load_dino", load)
    monkeypatch.setattr(Trained, "fit", fit)
    build(six_views, tmp_path / "scene", TRAINED)
    assert alive == [None]


def test_every_stage_receives_the_memory_budget(six_views, tmp_path, monkeypatch):
    granted = {}
    for module, name in ((geometry, "reconstruct"), (pipeline, "fit_codebook")):
        original = getattr(module, name)

        def receive(*args, name=name, original=original, **options):
            granted[name] = options["memory"]
            return original(*args, **options)

        monkeypatch.setattr(module, name, receive)
    for method in (Averaged, Trained):

        def fit(self, gaussians, views, config, run, *, original=method.fit):
            granted[self.name] = run.memory
            return original(self, gaussians, views, config, run)

        monkeypatch.setattr(method, "fit", fit)
    for config in (AVERAGED, TRAINED):
        build(six_views, tmp_path / config.method, replace(config, memory="900MB"))
    assert granted == dict.fromkeys(
        ("reconstruct", "fit_codebook", "averaged", "trained"), parse_bytes("900MB")
    )


def test_the_record_lists_the_stages_in_their_order_whichever_ran_again(built_by_method, six_views, tmp_path):
    copy = shutil.copytree(built_by_method / "averaged", tmp_path / "copy")
    folder = build(six_views, copy, replace(AVERAGED, iterations=5))
    assert list(folder.record["stages"]) == ["reconstruct", "features", "language"]
    assert list(SceneFolder.open(copy).record["stages"]) == ["reconstruct", "features", "language"]
