"""The whole way on a GPU, on a pretended one: every tensor is where CUDA wants it, and no loop waits for it.

The numbers are those of the CPU; see `pretended_gpu` for what this shows and what it cannot.
"""

import contextlib
import dataclasses
import io
import json
import shutil

import numpy as np
import pytest
import torch
from support import color_encoder
from support.encoder_folders import save_model, seeded, tiny_vit
from support.held_out import held_out_psnr
from support.language_scene import LanguageScene, make_scene
from support.tiny_capture import write_capture
from support.viewer_scene import WORDS, ball_scene

from lexsplat.captures import Capture, load_capture
from lexsplat.captures.sfm.triangulation import InitialPoints, initial_points
from lexsplat.codebook import CodebookConfig, assign_code_maps, fit_codebook
from lexsplat.features import FeatureConfig, extract_features
from lexsplat.features.clip import ClipEncoder
from lexsplat.features.dino import DinoEncoder
from lexsplat.language.fields import TrainedField, field_from_tensors
from lexsplat.language.methods.averaged import (
    AveragedConfig,
    features_of_codes,
    field_from_means,
)
from lexsplat.language.methods.averaging import average_features
from lexsplat.language.methods.joint import JointTrainer
from lexsplat.language.methods.trained import train_field
from lexsplat.language.methods.trained_settings import TrainedConfig
from lexsplat.language.methods.trainer import FieldTrainer
from lexsplat.reconstruction import ReconstructionConfig, Reconstructor
from lexsplat.rendering import prepare, render
from lexsplat.scenes.editing import Editor, Motion

GEOMETRY = ReconstructionConfig(
    iterations=6, sh_degree=1, max_gaussians=230, densify_min_every=2, grow_gradient=1e-7, exposure=True
)
LANGUAGE = TrainedConfig(iterations=4, pixel_sample=100, smoothing_sample=20)


pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("one_thread")]


@pytest.fixture(scope="module")
def capture(tiny_capture) -> Capture:
    return load_capture(tiny_capture, downscale=3.0)


@pytest.fixture(scope="module")
def points(capture) -> InitialPoints:
    found = initial_points(capture)
    return dataclasses.replace(found, points=found.points[::5], colors=found.colors[::5])


@pytest.fixture(scope="module")
def balls() -> LanguageScene:
    return make_scene(per_ball=12, views=3, width=24, height=18)


def devices(tensors):
    return {str(tensor.device) for tensor in tensors}


# -- reconstruction


@pytest.mark.parametrize("strategy", ["default", "mcmc"])
def test_a_reconstruction_on_the_gpu_sees_what_one_on_the_cpu_sees(pretended_gpu, capture, points, strategy):
    config = dataclasses.replace(GEOMETRY, strategy=strategy)
    found = {}
    for device in ("cpu", "cuda"):
        trainer = Reconstructor(capture, config, points, device=device, seed=3)
        for _ in range(2):
            trainer.step()
        found[device] = held_out_psnr(trainer, capture)
    assert found["cuda"] == pytest.approx(found["cpu"], abs=0.05)
    saved = trainer.state_dict()
    again = Reconstructor(capture, config, points, device="cuda", seed=4)
    again.load_state_dict(on_host(saved))
    for one in (trainer, again):
        one.run()
    left, right = trainer.gaussians(), again.gaussians()
    assert devices(left.tensors().values()) == {"cuda:0"}
    assert len(points.points) < len(left) <= 230
    for name, tensor in left.tensors().items():
        assert torch.equal(tensor, right.tensors()[name]), name
    assert trainer.metrics["psnr"] > 5


def on_host(state):
    """What a checkpoint gives back: the same numbers on the host."""
    return {name: tensor.cpu() for name, tensor in state.items()}


def test_a_step_of_the_reconstruction_has_no_wait_of_our_own(pretended_gpu, capture, points):
    config = dataclasses.replace(GEOMETRY, iterations=60, densify_min_every=1000, warm_up=0.0)
    trainer = Reconstructor(capture, config, points, device="cuda")
    for _ in range(len(capture.train_views) + 1):  # every photo is loaded by then
        trainer.step()
    while trainer.steps_done % 10:
        trainer.step()
    pretended_gpu.clear()
    for _ in range(9):  # the tenth reads the loss
        trainer.step()
    assert not pretended_gpu, pretended_gpu
    trainer.step()
    assert 0 < sum(pretended_gpu.values()) <= 4, pretended_gpu


def test_a_pose_gets_its_gradient_on_the_gpu(pretended_gpu, balls):
    camera = balls.cameras["view0"]
    gradients = []
    for device in ("cpu", "cuda"):
        pose = torch.tensor(camera.viewmat, dtype=torch.float32, device=device, requires_grad=True)
        render(balls.gaussians.to(device), camera, viewmat=pose).image.square().mean().backward()
        gradients.append(pose.grad.cpu())
    torch.testing.assert_close(*gradients, rtol=1e-2, atol=1e-4)


# -- features and codes


def test_features_and_codes_on_the_gpu(pretended_gpu, capture, clip_folder, tmp_path):
    views = dict(list(capture.views.items())[:2])
    few = dataclasses.replace(capture, views=views)
    config = FeatureConfig(
        crop_sizes=(1.0,), crop_strides=(0.5,), map_cells=4, dino_short_side=16, dino_stride=8, dino_layer=1
    )
    maps = {}
    save_model(seeded(tiny_vit), tmp_path / "dino")
    for device in ("cpu", "cuda"):
        clip = ClipEncoder(clip_folder, "tiny", device)
        dense = DinoEncoder(tmp_path / "dino", "tiny", device)
        maps[device] = extract_features(few, clip, dense, config, cache_dir=tmp_path / device)
        assert devices([clip.encode_text(["a red apple"])]) == {"cpu"}
    both = dataclasses.replace(config, crop_tokens="both")
    spoken = {
        d: extract_features(few, ClipEncoder(clip_folder, "tiny", d), None, both, cache_dir=tmp_path / d)
        for d in maps
    }
    for name in views:
        assert (spoken["cpu"][name].clip * spoken["cuda"][name].clip).sum(-1).min() > 0.99
    for name in views:  # in half precision on the GPU
        for part in ("clip", "dino"):
            here, there = (getattr(maps[device][name], part) for device in ("cpu", "cuda"))
            assert (here * there).sum(-1).min() > 0.99, part
    settings = CodebookConfig(num_codes=4, sample_size=200, steps=3)
    codebook = fit_codebook(maps["cuda"], list(views), settings, device="cuda")
    assert devices([codebook.clip, codebook.dino]) == {"cuda:0"}
    assert {codes.dtype for codes in assign_code_maps(maps["cuda"], codebook).values()} == {
        np.dtype(np.uint8)
    }


# -- language


@pytest.mark.parametrize("memory", [4 << 30, 4 * 9000])
def test_averaging_on_the_gpu_finds_the_same_means_and_codes(pretended_gpu, balls, memory, monkeypatch):
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (memory // 2, memory))
    config = AveragedConfig()
    maps = features_of_codes(balls.code_maps, balls.codebook)
    found = {
        d: average_features(balls.gaussians.to(d), balls.cameras, maps, config, memory=memory)
        for d in ("cpu", "cuda")
    }
    means = [torch.from_numpy(np.asarray(mean.means, np.float32)) for mean in found.values()]
    torch.testing.assert_close(means[1], means[0], atol=0.01, rtol=0)
    settings = CodebookConfig(num_codes=8, sample_size=50)
    field = field_from_means(found["cuda"], settings, config)
    assert devices(field.tensors().values()) - {"cpu"} == {"cuda:0"}
    stored = field_from_tensors({n: t.cpu() for n, t in field.tensors().items()}, field.metadata())
    assert torch.equal(stored.codes, field.codes.cpu())
    same = [dataclasses.replace(found["cpu"], means=found["cuda"].means, totals=found["cuda"].totals.cpu())]
    assert torch.equal(field_from_means(same[0], settings, config).codes, field.codes.cpu())


@pytest.mark.parametrize(
    "options", [{}, {"use_uncertainty": False}, {"uncertainty_form": "log"}, {"use_smoothing": False}]
)
def test_the_language_field_trains_on_the_gpu(pretended_gpu, balls, options):
    gaussians, codebook = balls.gaussians.to("cuda"), balls.codebook.to("cuda")
    config = dataclasses.replace(LANGUAGE, **options)
    field = train_field(gaussians, balls.cameras, balls.code_maps, codebook, config)
    assert isinstance(field, TrainedField)
    assert devices(field.parameters()) == {"cuda:0"}
    assert all(bool(parameter.isfinite().all()) for parameter in field.parameters())


def test_a_step_of_the_language_training_never_waits_for_the_gpu(pretended_gpu, balls):
    gaussians, codebook = balls.gaussians.to("cuda"), balls.codebook.to("cuda")
    trainer = FieldTrainer(gaussians, codebook, LANGUAGE)
    name, camera = next(iter(balls.cameras.items()))
    prepared = prepare(gaussians, camera)
    trainer.step(camera, balls.code_maps[name], prepared=prepared)
    pretended_gpu.clear()
    trainer.step(camera, balls.code_maps[name], prepared=prepared)
    assert not pretended_gpu, pretended_gpu


def test_joint_training_on_the_gpu(pretended_gpu, capture, points):
    cameras = {name: capture.views[name].camera for name in capture.train_names}
    code_maps = {name: np.random.default_rng(0).integers(0, 5, (6, 8), dtype=np.uint8) for name in cameras}
    codebook = make_scene(per_ball=2, views=1).codebook.to("cuda")
    reconstructor = Reconstructor(capture, GEOMETRY, points, device="cuda")
    joint = JointTrainer(reconstructor, cameras, code_maps, codebook, LANGUAGE)
    joint.run()
    gaussians, field = joint.result()
    assert len(field.semantics) == len(gaussians) > len(points.points)
    state = on_host(joint.state_dict())
    joint.load_state_dict(state)
    for name, tensor in joint.state_dict().items():
        assert torch.equal(tensor.cpu(), state[name]), name


# -- a finished scene


@pytest.fixture
def on_gpu(pretended_gpu):
    scene, ground_truth = ball_scene(20)
    scene.gaussians = scene.gaussians.to("cuda")
    stored = {name: tensor.to("cuda") for name, tensor in scene.field.tensors().items()}
    scene.field = field_from_tensors(stored, scene.field.metadata())
    return scene, ground_truth


def test_things_are_found_on_the_gpu(on_gpu):
    scene, ground_truth = on_gpu
    found = scene.find("ball 2")
    assert np.array_equal(found.mask.cpu().numpy(), ground_truth.labels == 2)
    assert found.present == "yes"
    for other in (found.grow(0.2), found.shrink(0.01), ~found, found.largest(), found.without_specks()):
        assert other.mask.is_cuda
    assert found.box.contains(found.center[None]).all()
    assert found.best_view in scene.views
    json.dumps(found.to_dict())
    assert scene.find("ball 1 nearest to ball 2") is not None
    name = next(iter(scene.views))
    assert scene.relevancy(["ball 2"], name).shape[:2] == scene.relevancy(["ball 1"], name).shape[:2]


def test_a_scene_is_edited_on_the_gpu(on_gpu):
    scene, ground_truth = on_gpu
    scene.embed(WORDS)  # what comes after an edit is no scene that embeds words by itself
    editor = Editor(scene)
    count = len(ground_truth.labels)
    editor.recolor(editor.scene.select("ball 0"), (1.0, 0.0, 0.0), strength=0.5)
    editor.move(editor.scene.select("ball 1"), Motion(translation=(0.0, 0.0, 0.3), scale=1.1))
    editor.duplicate(editor.scene.select("ball 2"), Motion(translation=(0.0, 0.0, 2.0)))
    editor.delete(editor.scene.select("ball 3"))
    assert len(editor.scene.gaussians) == count
    assert devices(editor.scene.gaussians.tensors().values()) == {"cuda:0"}
    assert editor.undo()
    assert len(editor.scene.gaussians) == count + 20
    editor.keep(editor.scene.select("ball 4"))
    assert len(editor.scene.gaussians) == 20


def test_the_viewer_answers_on_the_gpu(on_gpu):
    from lexsplat.viewer.coloring import MODES
    from lexsplat.viewer.history import History
    from lexsplat.viewer.requests import Asked
    from lexsplat.viewer.session import Session

    scene, ground_truth = on_gpu
    session = Session(scene, 1_000_000, History(vocabulary=[*WORDS, "spoon"]))
    session.warm_up()
    count = len(ground_truth.labels)
    labels = np.frombuffer(session.ask(Asked("ball 2")), np.uint8)[-count:]
    assert np.array_equal(labels > 0, ground_truth.labels == 2)
    for mode in MODES:
        assert len(session.colors(mode)) == 3 * count
    view = session.details(Asked("ball 2"))["views"][0]["name"]
    assert session.what_is(Asked(camera=ground_truth.cameras[view], click=(48.0, 36.0)))
    for ending in (".ply", ".splat"):
        assert session.export(Asked("ball 2"), ending)[1]
    assert session.edit("delete", Asked("ball 2"), {})["scene"]["gaussians"] < count


# -- the command line


def test_every_command_runs_with_device_cuda(pretended_gpu, built, tiny_capture, tmp_path):
    from lexsplat import cli

    scene = tmp_path / "scene"
    shutil.copytree(built, scene)

    def run(*arguments):
        out, err = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            status = cli.main([*map(str, arguments), "--device", "cuda"])
        assert status == 0, (arguments, err.getvalue())
        return out.getvalue()

    assert "red apple" in run("query", scene, "red apple", "--view", "view_02.png")
    assert "red apple" in run("find", scene, "red apple")
    assert "mIoU" in run("evaluate", scene)
    run("edit", scene, "recolor", "--select", "red apple", "--threshold", "0.02", "--color", "0", "0", "1")
    run("edit", scene, "save", "--output", tmp_path / "saved")
    run("export", tmp_path / "saved", tmp_path / "all.ply", "--language")
    run("scale", scene, "--distance", "1", "--points", "0,0,0", "0,0,1")
    assert (tmp_path / "all.ply").stat().st_size > 10_000


def test_all_baselines_are_compared_on_the_gpu(pretended_gpu, tmp_path, monkeypatch):
    from support.experiments import CONFIG, compared

    from lexsplat.evaluation import EvaluationConfig
    from lexsplat.evaluation.baselines import BASELINES, Dff, DffConfig, Ovs3d, Ovs3dConfig
    from lexsplat.evaluation.compare import ComparisonPlan

    color_encoder.install(monkeypatch)
    monkeypatch.setitem(BASELINES, "dff", Dff(DffConfig(steps=2)))
    monkeypatch.setitem(BASELINES, "3dovs", Ovs3d(Ovs3dConfig(steps=2, pairs=16)))
    config = dataclasses.replace(
        CONFIG, device="cuda", iterations=3,
        reconstruction=dataclasses.replace(CONFIG.reconstruction, max_gaussians=150),
    )  # fmt: skip
    capture = write_capture(tmp_path / "capture", views=5, width=40, height=30)
    plan = ComparisonPlan(methods=tuple(BASELINES))
    evaluation = EvaluationConfig(lpips=False)
    compared(capture, tmp_path / "out", config, plan, evaluation=evaluation)
    rows = json.loads((tmp_path / "out" / "comparison.json").read_text())
    assert set(BASELINES) <= set(json.dumps(rows).replace('"', " ").replace(",", " ").split())
