"""What a published page makes of its files: kinds of splats, text towers, damage, sizes; in headless Chromium."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.encoder_folders import write_clip
from support.language_scene import CENTERS
from support.page_browser import CHROMIUM, HALF, ask, open_page, picture, serving, show, until
from support.siglip_folder import siglip_folder
from support.viewer_scene import ball_scene

from lexsplat.features.encoders import load_clip
from lexsplat.geometry.cameras import Camera
from lexsplat.queries.picking import surface_at
from lexsplat.scenes.publishing import PublishOptions, publish, splat_file, vocabulary
from lexsplat.scenes.publishing.manifest import checksums
from lexsplat.scenes.publishing.rules import part_rule, segment_rule

PIXEL_SCALE = HALF
pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on the path")]

SIZE = {"width": 480, "height": 360}
HOSTILE = "<img src=x onerror='window.pwned=1'></script><script>window.pwned=1</script>\"'{{TITLE}}"


WORDS = dict.fromkeys([*(f"ball {n}" for n in range(5)), "toy", "chair", "bed"], "n")


@pytest.fixture
def ball_page(tmp_path, monkeypatch):
    """Publishes the scene of balls with some options; returns the folder and the ground truth."""
    monkeypatch.setattr(vocabulary, "everyday_phrases", lambda bundled: WORDS)
    scene, ground_truth = ball_scene()

    def write(target=tmp_path / "page", **options):
        publish(scene, target, PublishOptions(**{"words_only": True, **options}))
        return target

    write.scene, write.ground_truth = scene, ground_truth
    return write


@pytest.fixture(scope="module")
def plain_folder(tmp_path_factory) -> Path:
    """The folder that `ball_page` publishes without options; read-only."""
    target = tmp_path_factory.mktemp("plain") / "page"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(vocabulary, "everyday_phrases", lambda bundled: WORDS)
        publish(ball_scene()[0], target, PublishOptions(words_only=True))
    return target


@pytest.fixture(scope="module")
def plain_address(plain_folder) -> Iterator[str]:
    with serving(plain_folder) as found:
        yield found


@pytest.fixture(scope="module")
def plain_page(browser, plain_address) -> Iterator[Any]:
    """That page where a photo was taken, for tests that need no other."""
    opened = open_page(browser, plain_address + "#view=view0", 720, 480, scale=HALF)
    yield opened
    opened.close()


def test_a_typing_error_finds_the_word_and_an_unknown_phrase_is_reported_without_a_text_tower(plain_page):
    page = plain_page
    assert page.evaluate("lexsplat.app.source.dictionary.similar('bal 3')[0]") == "ball 3"
    page.fill(".search input", "a green unicorn")
    page.keyboard.press("Enter")
    until(page, "document.querySelector('.status')?.textContent.includes('is not among')")
    assert page.locator(".card").count() == 0


@pytest.mark.parametrize("ending", ["ply", "spz", "sog"])
def test_every_kind_of_splat_file_keeps_the_order_of_the_codes(tab, ball_page, monkeypatch, ending):
    if ending != "ply":
        monkeypatch.setattr(splat_file, "SMALL_BYTES", 0)
    if ending == "sog":
        monkeypatch.setattr(splat_file, "LARGE_BYTES", 0)
        monkeypatch.setattr(
            splat_file, "write_spz", lambda gaussians, path, version: path.write_bytes(b" " * 10**7)
        )
    scene = ball_page.scene
    folder = ball_page()
    assert (folder / f"scene.{ending}").exists()
    with serving(folder) as address:
        page = show(tab, address)
        geometry = page.evaluate(
            "(({ centers, opacities }) => [[...centers], [...opacities]])(lexsplat.app.geometry)"
        )
        ask(page, "ball 3")
        assert "here, one place" in page.locator(".card").inner_text()
    centers, opacities = np.array(geometry[0]).reshape(-1, 3), np.array(geometry[1])
    assert np.abs(centers - scene.gaussians.means.numpy()).max() < 2e-3
    assert np.abs(opacities - scene.gaussians.opacities.numpy()).max() < 0.01


@pytest.mark.parametrize("family", ["clip", "siglip"])
def test_the_text_tower_of_another_encoder_answers_in_the_page_as_in_python(tab, ball_page, tmp_path, family):
    model = tmp_path / family
    model.mkdir()
    if family == "siglip":
        pytest.importorskip("sentencepiece", reason="needs the extra `siglip`")
        siglip_folder(model, width=32)
    else:
        write_clip(model, width=32)
    ball_page.scene.clip = str(model)
    texts = ["A Car!", "the wooden table", "red mug, blue books and an apple on the table", "Ünknown 42"]
    with serving(ball_page(words_only=False)) as address:
        page = show(tab, address)
        ask(page, "ball 3")
        needed = [url for url in page.requested if url.endswith(("text.safetensors", "tokenizer.json"))]
        assert not needed, "a phrase of the dictionary needs no text tower"
        found = page.evaluate(
            """async (texts) => {
                const tower = await lexsplat.app.source.loader.load();
                return texts.map((text) => [...tower.embed(text)]);
            }""",
            texts,
        )
        ask(page, "a green unicorn")
        assert page.locator(".card strong").inner_text() == "a green unicorn"
    expected = load_clip(str(model)).encode_text(texts)
    cosines = torch.nn.functional.cosine_similarity(torch.tensor(found), expected, dim=1)
    assert float(cosines.min()) > 1 - 1e-3


def test_a_large_text_tower_is_loaded_only_after_its_size_was_reported(tab, ball_page, tmp_path):
    model = tmp_path / "siglip"
    model.mkdir()
    siglip_folder(model, width=32)
    ball_page.scene.clip = str(model)
    folder = ball_page(words_only=False)
    path = folder / "text.safetensors"
    manifest = json.loads((folder / "manifest.json").read_text())
    content = path.read_bytes() + bytes(12_000_000 - path.stat().st_size)  # safetensors end before
    path.write_bytes(content)
    manifest["files"][path.name] = checksums(content)
    (folder / "manifest.json").write_text(json.dumps(manifest))
    with serving(folder) as address:
        page = show(tab, address)
        page.fill(".search input", "a green unicorn")
        page.keyboard.press("Enter")
        button = page.get_by_role("button", name="Load the text model (12 MB) to ask anything")
        button.wait_for()
        assert not [url for url in page.requested if url.endswith(path.name)]
        button.click()
        until(page, "Boolean(document.querySelector('.card'))")
        assert [url for url in page.requested if url.endswith(path.name)]


def test_a_click_names_the_thing(plain_page, ball_page):
    page = plain_page
    centers = list(CENTERS)
    pixels = page.evaluate(
        """(points) => points.map((point) => {
            const at = lexsplat.app.stage.camera.position.clone().fromArray(point);
            const hit = lexsplat.app.stage.pixel(at);
            return [hit.x, hit.y];
        })""",
        [center.tolist() for center in centers],
    )
    camera = ball_page.scene.camera("view0")
    nearest = int(np.argmin([np.linalg.norm(center - camera.position) for center in centers]))
    page.evaluate("(at) => lexsplat.app.whatIs(at[0], at[1]).then(() => null)", pixels[nearest])
    assert page.locator(".status .examples button").first.inner_text() == f"ball {nearest}"


def test_two_clicks_measure_the_distance_between_the_surfaces_there(plain_page, ball_page):
    page, scene = plain_page, ball_page.scene
    page.evaluate("lexsplat.app.clear()")
    page.locator(".search input").fill("")
    page.locator("canvas").focus()
    page.evaluate("lexsplat.app.jump(lexsplat.app.manifest.views.find((v) => v.name === 'view0'))")
    page.evaluate("lexsplat.app.stage.settled()")
    lens = page.evaluate("lexsplat.app.stage.lens()")
    width, height, focal, x, y = lens["lens"]
    K = np.array([[focal, 0, x], [0, focal, y], [0, 0, 1]])
    camera = Camera(width, height, K, np.array(lens["viewmat"]).reshape(4, 4))
    places = (camera.viewmat[:3, :3] @ CENTERS.T).T + camera.viewmat[:3, 3]
    pixels = (places @ K.T)[:, :2] / places[:, 2:]
    free = [at for at in pixels if 60 < at[0] < width - 100 and 70 < at[1] < height - 60][:2]
    first, second = (surface_at(scene.gaussians, camera, *at).point for at in free)
    page.keyboard.press("m")
    for at in free:
        page.mouse.click(*at)
    until(page, "document.querySelector('.distance').textContent !== ''")
    told = page.locator(".distance").inner_text()
    assert told.endswith(" units")
    until(page, "document.querySelector('.status').textContent.endsWith('units (the scale is not known)')")
    marks = [one.bounding_box() for one in page.locator(".mark").all()]
    label = page.locator(".distance").bounding_box()
    assert label["y"] + label["height"] <= min(mark["y"] for mark in marks), "the text hides no point"
    assert float(told.split()[0]) == pytest.approx(np.linalg.norm(first - second), rel=0.03)


def test_names_titles_and_prompts_of_others_run_no_script(tab, ball_page, tmp_path, monkeypatch):
    scene = ball_page.scene
    scene.views = {HOSTILE if name == "view0" else name: view for name, view in scene.views.items()}
    words = vocabulary.everyday_phrases(False)
    vocabulary.everyday_phrases = lambda bundled: {HOSTILE.lower(): "a", **words}  # undone by the fixture
    monkeypatch.setattr(vocabulary, "_is_thing", lambda phrase: True)
    for single in (False, True):
        target = tmp_path / ("hostile.html" if single else "hostile")
        ball_page(target, title=HOSTILE, description=HOSTILE, start_view=HOSTILE, single_file=single)
    with serving(tmp_path / "hostile") as address:
        for place in (f"{address}#q={HOSTILE}&view={HOSTILE}", (tmp_path / "hostile.html").as_uri()):
            page = show(tab, place)
            page.keyboard.press("v")
            page.fill(".search input", "<img")
            until(page, "document.querySelectorAll('#completions li').length > 0")
            ask(page, HOSTILE.replace(",", ""))
            assert page.evaluate("window.pwned") is None
            assert page.title() == " ".join(HOSTILE.split())
            assert page.locator("h1").inner_text() == " ".join(HOSTILE.split())
            assert page.locator("main img").count() == 0


def test_a_single_file_opens_by_double_click_and_a_folder_says_what_to_do(tab, ball_page, tmp_path):
    single = ball_page(tmp_path / "balls.html", single_file=True)
    page = show(tab, single.as_uri())
    ask(page, "ball 3")
    assert "here" in page.locator(".card").inner_text()
    assert not [url for url in page.requested if not url.startswith(("file:", "blob:", "data:"))]
    page = show(tab, (ball_page() / "index.html").as_uri())
    assert "python -m http.server" in page.locator(".failure").inner_text()


def test_the_picture_comes_before_the_words_and_what_is_typed_meanwhile_is_answered(browser, plain_address):
    hold = """
        const own = window.fetch;
        const held = (name) => name === "words.bin" ? new Promise((go) => (window.go = go)) : Promise.resolve();
        window.fetch = (name, ...rest) => held(name).then(() => own(name, ...rest));
    """
    page = browser.new_page(viewport=SIZE, device_scale_factor=HALF, reduced_motion="reduce")
    page.set_default_timeout(60_000)
    page.add_init_script(hold)
    page.requested = []
    page.on("request", lambda request: page.requested.append(request.url.rpartition("/")[2]))
    page.goto(plain_address)
    until(page, "Boolean(window.go)")
    assert {"codes.bin", "words.txt", "words.bin"}.isdisjoint(
        page.requested[: page.requested.index("scene.ply") + 1]
    )
    assert page.evaluate("document.querySelector('.progress')") is None
    page.fill(".search input", "ball 3")
    page.keyboard.press("Enter")
    until(page, "document.querySelector('.status').textContent.includes('loading')")
    assert page.locator(".card").count() == 0
    page.evaluate("window.go()")
    until(page, "Boolean(document.querySelector('.card'))")
    assert "here, one place" in page.locator(".card").inner_text()
    page.close()


def test_of_too_many_gaussians_those_that_cover_most_from_the_camera_are_drawn_and_it_is_reported(
    tab, ball_page, monkeypatch
):
    """The importance of each is worked out here from the scene: opacity times area over squared depth."""
    monkeypatch.setattr("lexsplat.scenes.publishing.writing.DRAWN_SPLATS", 400)
    gaussians = ball_page.scene.gaussians
    with serving(ball_page()) as address:
        page = show(tab, address + "#view=view0", 720, 480)
        told = page.locator(".title").inner_text()
        assert "The page leaves out 1,100 of 1,500: those that cover least of the picture from here." in told
        assert "leaves out 1,100" in page.locator("dialog p.fine").first.text_content()
        drawn = {}
        for view in ("view0", "view3"):
            page.evaluate(
                "(name) => lexsplat.app.jump(lexsplat.app.manifest.views.find((v) => v.name === name))", view
            )
            page.evaluate("lexsplat.app.stage.settled()")
            assert page.evaluate("lexsplat.app.stage.drawn") == 400
            drawn[view] = 1 - np.array(page.evaluate("[...lexsplat.app.budget.out]"))
            viewmat = ball_page.scene.camera(view).viewmat
            seen = gaussians.means.numpy() @ viewmat[:3, :3].T + viewmat[:3, 3]
            scales = np.sort(gaussians.scales.numpy(), 1)
            covers = gaussians.opacities.numpy() * scales[:, 1] * scales[:, 2]
            worth = np.where(seen[:, 2] > 0.01, covers / seen[:, 2] ** 2, 0)
            own = drawn[view].astype(bool)
            anywhere = np.argsort(-covers)[:100]
            rest = np.setdiff1d(np.flatnonzero(own), anywhere)
            assert own.sum() == 400
            left = np.flatnonzero(
                ~own & (np.abs(seen[:, :2]) < 0.2 * seen[:, 2:]).all(1)
            )  # in the picture's middle
            assert worth[rest].min() > 0.9 * worth[left].max(), (
                "none in the picture is left out for a lesser one"
            )
        assert (drawn["view0"] != drawn["view3"]).sum() > 50
        ask(page, "ball 3")
        assert "here, one place" in page.locator(".card").inner_text(), "answers know all Gaussians"


COUNTING = """
    const own = HTMLCanvasElement.prototype.getContext;
    window.calls = [];
    HTMLCanvasElement.prototype.getContext = function (kind, ...rest) {
        const gl = own.call(this, kind, ...rest);
        if (kind === "webgl2" && gl && !gl.counted) {
            gl.counted = true;
            for (const name of ["drawElementsInstanced", "readPixels"]) {
                const plain = gl[name].bind(gl);
                gl[name] = (...given) => (window.calls.push([name, this.width, given.at(-1)]), plain(...given));
            }
        }
        return gl;
    };
"""


def test_software_draws_coarsely_at_first_and_a_prompt_computes_and_sorts_no_splat(browser, plain_address):
    page = open_page(browser, plain_address + "#view=view0", 720, 480, COUNTING)
    page.evaluate("lexsplat.app.stage.settled()")
    drawn = [call for call in page.evaluate("calls") if call[0] == "drawElementsInstanced"]
    assert drawn[0][1] == 360, "half the resolution"
    assert drawn[-1][1] == 720
    assert all(instances == 12 for _, _, instances in drawn), "1,500 splats, 128 to an instance"
    assert "readPixels" in {name for name, *_ in page.evaluate("calls")}, "the splats were sorted"
    before = picture(page)
    page.evaluate("window.calls.length = 0")
    page.evaluate("lexsplat.app.ask('ball 3', false, false)")
    after = picture(page)
    assert np.abs(after - before)[:, 330:].max() > 60
    assert {name for name, *_ in page.evaluate("calls")} == {"drawElementsInstanced"}
    page.close()


def test_a_damaged_file_and_a_browser_without_webgl_are_reported_in_one_line(
    browser, tab, plain_folder, plain_address, tmp_path
):
    damaged = tmp_path / "damaged"
    shutil.copytree(plain_folder, damaged)
    content = bytearray((damaged / "codes.bin").read_bytes())
    content[100] ^= 1
    (damaged / "codes.bin").write_bytes(content)
    with serving(damaged) as address:
        page = show(tab, address)
        until(page, "Boolean(document.querySelector('.failure'))")
        assert page.locator(".failure").inner_text().startswith("codes.bin: expected the")
    (damaged / "page.wasm").write_bytes(b"damaged")
    with serving(damaged) as address:
        page = show(tab, address)
        assert page.locator(".failure").inner_text().startswith("page.wasm: expected WebAssembly")
    nothing = "HTMLCanvasElement.prototype.getContext = () => null"
    page = open_page(browser, plain_address, script=nothing, scale=HALF)
    assert "needs WebGL 2" in page.locator(".failure").inner_text()
    page.close()


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda m: m.pop("views"), "a list of cameras in views"),
        (lambda m: m["scene"].pop("rotation"), "4 numbers in scene.rotation"),
        (lambda m: m["scene"].update(gaussians="many"), "a number in scene.gaussians"),
        (lambda m: m["views"][0].update(viewmat=[1]), "a list of cameras in views"),
        (lambda m: m.update(language=None), "language or a server"),
        (
            lambda m: m["language"].update(segments="s", segment_rule=None),
            "9 numbers in language.segment_rule",
        ),
        (
            lambda m: m["language"].update(
                segments="s",
                segment_rule=dict.fromkeys(segment_rule(), 1),
            ),
            "24 numbers in language.part_rule",
        ),
        (
            lambda m: (
                m["language"].update(
                    segments="s",
                    segment_rule=dict.fromkeys(segment_rule(), 1),
                    part_rule=dict.fromkeys(part_rule(), 1),
                ),
                m["words"]["rule"].update(parts=[1]),
            ),
            "lists of names, qualities, colors, parts, gone in words.rule",
        ),
        (lambda m: (m.update(text={}), m["words"].pop("rule")), "16 numbers in words.rule"),
        (lambda m: (m.update(text={}), m["words"]["rule"].update(alike=[1])), "names of parts in words.rule"),
        (lambda m: m["selection_rule"].pop("link"), "11 numbers in selection_rule"),
        (lambda m: m.pop("grammar"), "an object in grammar"),
        (lambda m: m["files"].pop("scene.ply"), "scene.ply in files"),
        (lambda m: m.clear(), "version 8 of a lexsplat page"),
    ],
)
def test_a_manifest_that_lacks_a_field_is_refused_by_its_name(tab, plain_folder, tmp_path, change, told):
    folder = shutil.copytree(plain_folder, tmp_path / "page")
    manifest = json.loads((folder / "manifest.json").read_text())
    change(manifest)
    (folder / "manifest.json").write_text(json.dumps(manifest))
    with serving(folder) as address:
        page = show(tab, address)
        line = page.locator(".failure").inner_text().strip()
    assert line.startswith(f"manifest.json: expected {told}, found ")
    assert "\n" not in line
