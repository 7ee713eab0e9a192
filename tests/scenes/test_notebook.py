"""What a notebook shows of a scene and of a selection."""

import base64
import io
import re

import numpy as np
import pytest
from PIL import Image
from support.viewer_scene import ball_scene

from lexsplat.scenes.scene import Scene


@pytest.fixture(scope="module")
def three_balls() -> Scene:
    return ball_scene()[0]


def image_of(html: str) -> np.ndarray:
    (data,) = re.findall(r'<img src="data:image/png;base64,([^"]+)">', html)
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(data))))


def facts_of(html: str) -> dict[str, str]:
    return dict(re.findall(r"<tr><th>(.*?)</th><td>(.*?)</td></tr>", html))


def test_a_scene_shows_its_facts_and_its_first_view(three_balls):
    html = three_balls._repr_html_()
    facts = facts_of(html)
    assert (facts["gaussians"], facts["views"]) == ("1,500", "6")
    assert "scale" not in facts, "it is unknown"
    shown = three_balls.render(next(iter(three_balls.views))).image.clamp(0, 1).numpy()
    assert np.abs(image_of(html) / 255 - shown).max() < 0.5 / 255 + 1e-6


def test_a_selection_shows_its_facts_and_is_marked_in_its_best_view(three_balls):
    found = three_balls.find("ball 2")
    html = found._repr_html_()
    facts = facts_of(html)
    assert (facts["phrase"], facts["present"], facts["count"]) == ("ball 2", "yes", "1")
    assert facts["best view"] == found.best_view
    assert facts["sizes"] == " x ".join(f"{side:.3g}" for side in found.size) + " units"
    plain = three_balls.render(found.best_view).image.clamp(0, 1).numpy()
    brightness = (image_of(html) / 255).mean(-1) / np.maximum(plain.mean(-1), 0.05)
    inside = three_balls.relevancy("ball 2", found.best_view)[0].numpy() > 0.9
    assert inside.any()
    assert brightness[inside].min() > 1
    assert np.median(brightness[~inside & (plain.mean(-1) > 0.2)]) < 0.5, "the rest is dimmed"


def test_what_is_not_there_has_no_image_and_words_of_others_are_no_elements(three_balls):
    html = (three_balls.find("ball 2") & three_balls.find("ball 3"))._repr_html_()
    assert "<img" not in html
    named = three_balls.find("ball 1").described(phrase="<script>")._repr_html_()
    assert "<script>" not in named
    assert facts_of(named)["phrase"] == "&lt;script&gt;"
