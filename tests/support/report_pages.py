"""A small synthetic evaluation and a parser of report pages."""

from __future__ import annotations

from html.parser import HTMLParser

import numpy as np

from lexsplat.evaluation import Metrics, PairResult, ViewImages, precision_curves, summarize_language
from lexsplat.evaluation.metrics import average_precision, mask_scores, threshold_counts
from lexsplat.evaluation.protocols import Lerf2dScores, OfficialScores
from lexsplat.evaluation.report import Gallery

NASTY = '<script>alert("x")</script> & more'
PROMPTS = ("red apple", NASTY)
VOID = {"meta", "img", "link", "br", "input"}


class Page(HTMLParser):
    """Checks that tags are nested correctly; collects texts, attributes and table rows."""

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.open, self.tags, self.attributes, self.text, self.rows = [], [], [], [], []
        self.feed(text)
        self.close()
        assert not self.open, f"not closed: {self.open}"

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += attrs
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += attrs

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)
        if self.rows and {"td", "th"} & set(self.open):
            self.rows[-1][-1] += data


def evaluated(views=3):
    """Metrics and images of a synthetic evaluation; the nasty prompt has the lower scores."""
    rng = np.random.default_rng(0)
    gallery, pairs = Gallery(width=60), {}
    thresholds = {prompt: {"auto": 0.5, "fixed": 0.5, "oracle": 0.4} for prompt in PROMPTS}
    for number in range(views):
        name = f"view {number}.png"
        ground_truth = np.zeros((24, 32), bool)
        ground_truth[6:14, 5 + number : 20] = True
        maps = {
            prompt: np.clip(ground_truth * 0.6 + noise * rng.random(ground_truth.shape), 0, 1).astype(
                np.float32
            )
            for prompt, noise in zip(PROMPTS, (0.52, 0.9))
        }
        photo, image = (rng.random((12, 16, 3)).astype(np.float32) for _ in range(2))
        automatic = dict.fromkeys(PROMPTS, 0.5)
        gallery.add(ViewImages(name, photo, image, maps, dict.fromkeys(PROMPTS, ground_truth), automatic))
        pairs[name] = {
            prompt: PairResult(
                threshold_counts(scores, ground_truth),
                mask_scores(scores >= 0.5, ground_truth),
                average_precision(scores, ground_truth), 1.0,
                OfficialScores(0.5, 0.9, 0.6, 1.0), Lerf2dScores(0.3, True), 0.25,
            )
            for prompt, scores in maps.items()
        }  # fmt: skip
    metrics = Metrics(
        quality={"psnr": 31.234, "ssim": 0.912, "lpips": None, "lpips_reason": "not <installed>",
                 "per_view": {name: {"psnr": 31.234, "ssim": 0.912, "lpips": None} for name in pairs}},
        language={"form": "feature", "method": "averaged", **summarize_language(pairs, thresholds)},
        speed={"render_fps": 12.34, "rgb_fps": 20.0, "query_ms": 9.87, "stage_seconds": {"language": 3.5}},
        size={"gaussians": 12345, "language_bytes": 150_000, "gaussian_bytes": 2_500_000,
              "peak_rss_bytes": 1_200_000_000, "peak_gpu_bytes": None},
        config={"seed": 0, "note": "</pre><script>"},
        machine={"cpu": "a <b> chip", "versions": {"lexsplat": "1.2", "torch": "2"}},
        curves=precision_curves(pairs),
        thresholds=thresholds,
        pairs=pairs,
    )  # fmt: skip
    return metrics, gallery
