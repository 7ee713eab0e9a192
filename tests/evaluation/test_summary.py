"""How the scores of prompts in views become the metrics of a scene, by hand."""

import numpy as np
import pytest

from lexsplat.evaluation.metrics import THRESHOLDS, MaskScores, ThresholdCounts
from lexsplat.evaluation.protocols import Lerf2dScores, OfficialScores
from lexsplat.evaluation.results import PairResult
from lexsplat.evaluation.summary import mean_of, summarize_kinds, summarize_language

THRESHOLD = {"auto": 0.5, "fixed": 0.5, "oracle": 0.5}


def pair(value: float) -> PairResult:
    """A pair whose scores are all ``value``; at every threshold its IoU is ``value`` of ten pixels."""
    hits = np.full(len(THRESHOLDS), round(10 * value))
    hits[0] = 10
    return PairResult(
        ThresholdCounts(hits, np.zeros(len(THRESHOLDS), int)),
        MaskScores(value, value, value),
        value,
        value,
        OfficialScores(value, value, value, value),
        Lerf2dScores(value, value >= 0.5),
        value,
    )


PAIRS = {"one": {"cup": pair(0.2), "book": pair(0.4), "lamp": pair(0.6)}, "two": {"cup": pair(0.8)}}
LIMITS = dict.fromkeys(("cup", "book", "lamp"), THRESHOLD)


def test_strict_and_official_metrics_average_views_and_the_others_pairs():
    found = summarize_language(PAIRS, LIMITS)
    by_views, by_pairs = (0.4 + 0.8) / 2, (0.2 + 0.4 + 0.6 + 0.8) / 4
    for kind in ("auto", "fixed", "oracle"):
        assert found["strict"][kind]["mIoU"] == pytest.approx(by_views)
    assert found["strict"]["mAP"] == pytest.approx(by_views)
    assert found["official"]["mAP"] == pytest.approx(by_views)
    assert found["lerf_2d"] == pytest.approx({"mIoU": by_pairs, "localization": 0.5})
    assert found["lerf_3d"] == pytest.approx({"mIoU": by_pairs, "acc_25": 0.75, "acc_50": 0.5})
    assert found["per_prompt"]["cup"]["views"] == 2
    assert found["per_prompt"]["cup"]["AP"] == pytest.approx(0.5)
    assert found["per_view"]["one"]["mIoU"] == pytest.approx(0.4)


def test_kinds_of_prompts_are_averaged_apart():
    found = summarize_kinds(PAIRS, LIMITS, {"cup": "thing", "book": "thing", "lamp": "light"})
    assert list(found) == ["light", "thing"]
    assert found["light"]["mIoU_auto"] == pytest.approx(0.6)
    assert found["thing"]["mIoU_auto"] == pytest.approx((0.3 + 0.8) / 2)
    assert found["thing"]["prompts"] == 2


def test_unknown_scores_do_not_count():
    assert summarize_language({}, {}) is None
    assert mean_of([None, float("nan"), 0.5, 1.0]) == 0.75
    assert mean_of([None]) is None
