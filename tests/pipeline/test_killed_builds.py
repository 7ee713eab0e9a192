"""A build killed inside any of its stages, or at any moment, goes on and gives what an undisturbed one gives."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from support import killed_builds
from support.forked_commands import Command
from support.killed_builds import KILLS_A_SCENE
from support.tiny_capture import write_capture

STAGES = {
    "averaged": ["average"],
    "trained": ["reconstruct", "features", "codebook", "language"],
}
"""Methods and the stages inside which they are killed, by the names of their progress events.

The stages that both methods have are killed with one of them.
"""

ROUNDING = 2.0**-12
"""A resumed run encodes the crops of the photos that are left in other batches than an undisturbed one.

The last bit of a product depends on the number of rows on some processors. Rarely a feature is then rounded to the
next number of half precision, which is 2^-12 away below 0.5. A codeword is a mean of features, so it moves by less.
"""

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def killed(tmp_path_factory) -> dict[str, dict]:
    """By method, what came of builds that spend most of their time in trainings, which have the most to lose."""
    folder = tmp_path_factory.mktemp("killed")
    capture = write_capture(folder / "capture", views=6, width=64, height=48)
    options = [
        "build", str(capture), "--clip", "bundled", "--dino", "bundled", "--device", "cpu",
        "--features.crop-sizes", "0.5", "--features.crop-strides", "0.5", "--features.map-cells", "16",
        "--features.max-short-side", "36", "--features.dino-short-side", "48",
        "--iterations", "40", "--codebook.num-codes", "16", "--codebook.steps", "60", "--trained.iterations", "20",
        "--checkpoint-seconds", "0.05",
    ]  # fmt: skip
    with Command(str(folder), json.dumps(STAGES), *options, program=killed_builds.main) as killing:
        ended = killing.ended(seconds=900)
    assert ended.status == 0, ended.err[-2000:]
    return json.loads(ended.out.splitlines()[-1])


def results(scene: Path) -> dict[str, bytes]:
    files = [scene / "gaussians.ply", scene / "cameras.json", *sorted((scene / "codes").rglob("*.png"))]
    return {str(file.relative_to(scene)): file.read_bytes() for file in files}


def tensors(scene: Path):
    from safetensors.torch import load_file

    return load_file(scene / "language.safetensors")


@pytest.mark.parametrize("method", STAGES)
def test_kills_over_all_stages_do_not_change_the_result(killed, method):
    import torch

    report = killed[method]
    assert "failed" not in report
    assert report["kills"] >= KILLS_A_SCENE * len(STAGES[method])
    assert set(report["killed_inside"]) == set(STAGES[method])
    assert len(report["finished"]) >= len(STAGES[method])
    undisturbed = Path(report["undisturbed"])
    expected, language = results(undisturbed), tensors(undisturbed)
    for scene in map(Path, report["finished"]):
        assert results(scene) == expected
        found = tensors(scene)
        assert found.keys() == language.keys()
        for name, tensor in language.items():
            tolerance = ROUNDING if name.startswith("codebook.") else 0.0
            torch.testing.assert_close(found[name], tensor, rtol=0, atol=tolerance)
        assert not list(scene.rglob("*.tmp")), "half-written files are removed"
        assert not list((scene / "checkpoints").glob("*.training.safetensors"))
