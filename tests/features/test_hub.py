"""Finding models on the Hub: what is fetched, and one message for each way in which that fails. The Hub is mocked."""

from __future__ import annotations

import errno
import logging
import re
import shutil
from pathlib import Path
from types import SimpleNamespace

import huggingface_hub
import pytest
from huggingface_hub import constants, errors
from support.refusals import assert_reports

from lexsplat.features import hub
from lexsplat.features.dino import DEFAULT_DINO
from lexsplat.features.encoders import DEFAULT_CLIP, load_clip, load_dino
from lexsplat.runtime.errors import ModelError
from lexsplat.runtime.progress import NOTE

COMMIT = "0123456789abcdef0123456789abcdef01234567"
FILES = {
    "config.json": 1000,
    "tokenizer.json": 2000,
    "preprocessor_config.json": 300,
    "README.md": 5,
    "open_clip_config.json": 7,
    "open_clip_model.safetensors": 600_000_000,
    "open_clip_pytorch_model.bin": 600_000_001,
    "pytorch_model.bin": 600_000_002,
}


class Hub:
    """A Hub with one repository, of which the cache has nothing: records what is asked of it."""

    def __init__(self, monkeypatch, tmp_path: Path) -> None:
        self.files, self.license, self.revisions = dict(FILES), "mit", ["main"]
        self.error: BaseException | None = None
        self.late_error: BaseException | None = None
        self.fetched: list[dict] = []
        self.folder = tmp_path / "snapshot"
        self.cached: dict[str, Path] = {}
        monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
        monkeypatch.setattr(
            huggingface_hub.HfApi, "model_info", lambda api, name, **given: self.info(**given)
        )
        monkeypatch.setattr(huggingface_hub, "snapshot_download", self.fetch)

    def info(self, *, revision, files_metadata, timeout):
        assert files_metadata
        assert timeout <= 10
        if self.error is not None:
            raise self.error
        if revision not in self.revisions:
            raise hub_error(errors.RevisionNotFoundError, 404)
        siblings = [SimpleNamespace(rfilename=name, size=size) for name, size in self.files.items()]
        return SimpleNamespace(sha=COMMIT, siblings=siblings, card_data={"license": self.license})

    def fetch(self, name, *, revision, local_files_only=False, **options):
        if local_files_only:
            if revision not in self.cached:
                raise errors.LocalEntryNotFoundError("nothing cached")
            return str(self.cached[revision])
        if self.late_error is not None:
            raise self.late_error
        self.fetched.append({"name": name, "revision": revision, **options})
        return str(self.folder)


@pytest.fixture
def fake(monkeypatch, tmp_path) -> Hub:
    return Hub(monkeypatch, tmp_path)


def hub_error(kind, status: int):
    return kind("told", response=SimpleNamespace(status_code=status, headers={}, request=None))


def refused(*parts: str, name: str = "someone/model", load=load_clip) -> None:
    with pytest.raises(ModelError) as caught:
        load(name)
    assert_reports(caught.value, *parts)


def test_the_first_weights_that_exist_are_fetched_with_what_belongs_to_them(fake):
    wanted = ["config.json", "open_clip_model.safetensors", "preprocessor_config.json", "tokenizer.json"]
    assert hub.model_folder("someone/model", "clip") == fake.folder
    assert fake.fetched[-1]["allow_patterns"] == wanted
    assert fake.fetched[-1]["revision"] == COMMIT, "the revision whose files were listed"
    del fake.files["open_clip_model.safetensors"]
    hub.model_folder("someone/model", "dino")
    assert fake.fetched[-1]["allow_patterns"] == [
        "config.json",
        "preprocessor_config.json",
        "pytorch_model.bin",
    ]
    fake.files |= {"model.safetensors.index.json": 1, "model-00001-of-00001.safetensors": 2}
    hub.model_folder("someone/model", "dino")
    patterns = set(fake.fetched[-1]["allow_patterns"])
    assert {"model.safetensors.index.json", "model-00001-of-00001.safetensors"} < patterns
    fake.files["model.safetensors"] = 3
    hub.model_folder("someone/model", "dino")
    assert fake.fetched[-1]["allow_patterns"] == [
        "config.json",
        "model.safetensors",
        "preprocessor_config.json",
    ]


def test_license_and_size_are_reported_before_the_download(fake, caplog):
    fake.late_error = ConnectionError("gone")
    with caplog.at_level(NOTE, logger="lexsplat"):
        refused("internet")
    assert "someone/model: 600 MB are downloaded once" in caplog.text
    assert "license: mit" in caplog.text


@pytest.mark.parametrize(("name", "tower"), [(DEFAULT_CLIP, "clip"), (DEFAULT_DINO, "dino")])
def test_the_pinned_revision_is_taken_and_main_if_it_is_gone(fake, caplog, name, tower):
    pinned = hub.PINNED[name]
    assert re.fullmatch("[0-9a-f]{40}", pinned)
    asked = []
    inner = fake.info
    fake.info = lambda **given: asked.append(given["revision"]) or inner(**given)
    with caplog.at_level(logging.WARNING, logger="lexsplat"):
        hub.model_folder(name, tower)
    assert asked == [pinned, "main"]
    assert f"no revision {pinned[:8]}; main is taken" in caplog.text
    fake.revisions.append(pinned)
    asked.clear()
    hub.model_folder(name, tower)
    assert asked == [pinned]


def test_a_cached_model_needs_no_network(fake, clip_folder):
    fake.error = AssertionError("the network was used")
    for revision in (hub.PINNED[DEFAULT_CLIP], "main"):
        fake.cached = {revision: clip_folder}
        assert hub.model_folder(DEFAULT_CLIP, "clip") == clip_folder


def test_a_copy_in_the_cache_that_lacks_its_tokenizer_is_fetched_again(fake, clip_folder, tmp_path):
    partial = shutil.copytree(clip_folder, tmp_path / "partial")
    (partial / "tokenizer.json").unlink()
    fake.cached = {"main": partial}
    assert hub.model_folder("someone/model", "clip") == fake.folder
    assert hub.model_folder("someone/model", "dino") == partial, "DINO has no tokenizer"
    fake.error = ConnectionError("no route")
    refused("without a tokenizer", "cannot be reached", "connect to the internet")


def test_the_layout_of_the_hubs_cache_is_read(clip_folder, monkeypatch, tmp_path):
    """models--A--B/{refs,snapshots} with Hugging Face's own code; only the cache's location is mocked."""
    home = tmp_path / "models--someone--model"
    (home / "refs").mkdir(parents=True)
    (home / "refs" / "main").write_text(COMMIT)
    shutil.copytree(clip_folder, home / "snapshots" / COMMIT)
    original = huggingface_hub.snapshot_download
    monkeypatch.setattr(
        huggingface_hub,
        "snapshot_download",
        lambda *args, **options: original(*args, cache_dir=tmp_path, **options),
    )
    assert hub.model_folder("someone/model", "clip") == home / "snapshots" / COMMIT


@pytest.mark.parametrize("load", [load_clip, load_dino])
def test_a_missing_network_leaves_three_remedies(fake, load):
    fake.error = ConnectionError("no route")
    kind = "clip" if load is load_clip else "dino"
    refused(
        "someone/model", "cannot be reached", "internet", f"--{kind} FOLDER", f"--{kind} bundled", load=load
    )
    refused("someone/model", "go without (`--dino none`)", load=load_dino)


def test_a_name_that_may_be_a_missing_folder_is_reported_as_both(fake):
    fake.error = ConnectionError("no route")
    refused(
        "model enc/ok: expected a model folder or a downloaded model",
        "found no such folder, no local copy, and the hub cannot be reached (ConnectionError)",
        "; check the path, or connect to the internet",
        name="enc/ok",
    )
    fake.error = errors.OfflineModeIsEnabled("offline")
    refused("found no such folder, no local copy, and HF_HUB_OFFLINE is set", name="enc/ok")
    fake.error = hub_error(errors.HfHubHTTPError, 503)
    refused("found no such folder, and the hub responded with 503", name="enc/ok")
    with pytest.raises(ModelError) as caught:
        load_clip(DEFAULT_CLIP)
    assert "folder," not in str(caught.value).split(";")[0], "a default is no path"


@pytest.mark.parametrize("name", [DEFAULT_CLIP.lower(), DEFAULT_CLIP.upper(), f"{DEFAULT_CLIP[:-1]}O"])
def test_a_name_that_is_nearly_the_default_ones_is_told_how_that_is_spelt(fake, name):
    for error in (
        errors.OfflineModeIsEnabled("offline"),
        ConnectionError("no route"),
        hub_error(errors.RepositoryNotFoundError, 404),
    ):
        fake.error = error
        refused(f"; use `--clip {DEFAULT_CLIP}` if you mean that; or check the ", name=name)
    with pytest.raises(ModelError) as caught:
        load_clip("laion/CLIP-ViT-L-14-laion2B-s32B-b82K")
    assert DEFAULT_CLIP not in str(caught.value), "another model"


def test_each_cause_has_its_own_message(fake):
    fake.error = hub_error(errors.RepositoryNotFoundError, 404)
    refused("no such folder and no such model", "check the spelling")
    fake.error = hub_error(errors.HfHubHTTPError, 503)
    refused("the hub responded with 503")
    fake.error = errors.OfflineModeIsEnabled("offline")
    refused("HF_HUB_OFFLINE is set")
    fake.error = errors.HFValidationError("bad")
    refused("neither a folder nor a valid model name", name="not a//name")
    fake.error = None
    fake.late_error = hub_error(errors.GatedRepoError, 403)
    refused("gated", "https://huggingface.co/someone/model", "hf auth login", load=load_dino)
    fake.late_error = OSError(errno.EACCES, "Permission denied")
    refused("cache", "can be written", "HF_HOME")
    full = RuntimeError("writing failed")
    full.__cause__ = OSError(errno.ENOSPC, "No space left on device")
    fake.late_error = full
    refused("cache", "a full disk", "HF_HOME")


@pytest.mark.parametrize("kind", [TypeError, AttributeError, KeyError, IndexError, NameError, AssertionError])
def test_a_mistake_of_the_program_is_not_reported_as_a_hub_that_cannot_be_reached(fake, kind):
    for place in ("error", "late_error"):
        fake.error = fake.late_error = None
        setattr(fake, place, kind("a mistake"))
        with pytest.raises(kind, match="a mistake"):
            load_clip("someone/model")


@pytest.mark.parametrize("error", [RuntimeError("xet failed"), ValueError("no JSON"), TimeoutError("10 s")])
def test_errors_of_transports_of_any_type_are_reported_as_a_hub_that_cannot_be_reached(fake, error):
    fake.late_error = error
    refused(f"the hub cannot be reached ({type(error).__name__})")


def test_a_disk_without_enough_space_is_reported_before_the_download(fake, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=10_000_000))
    refused("600 MB of free space", "found 10 MB", "HF_HOME")
    assert not fake.fetched


@pytest.mark.parametrize(
    ("removed", "told"),
    [
        ("config.json", "another library"),
        ("tokenizer.json", "a tokenizer"),
        ("weights", "one of model.safetensors"),
    ],
)
def test_a_repository_without_a_needed_file_is_refused_before_the_download(fake, removed, told):
    endings = (".safetensors", ".bin") if removed == "weights" else (removed,)
    fake.files = {name: size for name, size in fake.files.items() if not name.endswith(endings)}
    fake.files |= {"open_clip_config.json": 7}
    refused(told)
    assert not fake.fetched


def test_a_file_is_refused_with_its_folder_and_a_path_that_is_not_there_without_the_network(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(hub, "_download", lambda *_: pytest.fail("the network is asked"))
    weights = tmp_path / "clip" / "model.safetensors"
    weights.parent.mkdir()
    weights.touch()
    with pytest.raises(ModelError, match=r"found a file; give another model, a folder \(`--clip FOLDER`\)"):
        hub.model_folder(str(weights), "clip")  # nothing beside it says that its folder is a model
    (weights.parent / "config.json").write_text("{}")
    with pytest.raises(
        ModelError, match=f"expected a model folder, found a file; give its folder: --clip {weights.parent}$"
    ):
        hub.model_folder(str(weights), "clip")
    for name in ("bundeld", "Bundled", "embeded"):
        with pytest.raises(
            ModelError, match=f"{name}: expected a model .* no such folder; use `--dino bundled`"
        ):
            hub.model_folder(name, "dino")
    for name in (tmp_path / "nowhere", "./nowhere", "~/no where", "models/clip/large"):
        with pytest.raises(
            ModelError, match="expected a model folder, or a name OWNER/NAME, found no such folder"
        ):
            hub.model_folder(str(name), "dino")


def test_a_repository_with_pickled_shards_alone_is_refused_by_their_name(fake):
    for name in [name for name in fake.files if "model" in name]:
        del fake.files[name]
    fake.files["pytorch_model.bin.index.json"] = 100
    with pytest.raises(
        ModelError, match=r"open_clip_pytorch_model.bin, found pytorch_model\.bin\.index\.json;"
    ):
        hub.model_folder("owner/name", "clip")
    assert not fake.fetched
