"""``lexsplat evaluate`` and ``lexsplat info``."""

import json
from html.parser import HTMLParser

import pytest
from support.command_line import fails_in_one_line

from lexsplat import cli

pytestmark = pytest.mark.xdist_group("built")


def test_evaluate_writes_metrics_and_a_report_without_external_files(built, capsys):
    assert cli.main(["evaluate", str(built), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    written = json.loads((built / "metrics.json").read_text())
    assert printed == written
    assert written["quality"]["psnr"] > 15
    strict = written["language"]["strict"]
    for form in ("auto", "fixed", "oracle"):
        assert set(strict[form]) >= {"mIoU", "mPA", "mP"}
    assert strict["oracle"]["mIoU"] >= max(strict["auto"]["mIoU"], strict["fixed"]["mIoU"])
    assert set(written) >= {"quality", "language", "speed", "size", "config", "machine"}
    html = (built / "report.html").read_text()
    HTMLParser().feed(html)
    assert 'src="http' not in html
    assert "red apple" in html


def test_info_prints_the_contents_of_a_scene(built, capsys):
    assert cli.main(["info", str(built), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["views"] == {"training": 9, "held out": 3}
    assert facts["gaussians"] > 0
    assert cli.main(["info", str(built)]) == 0
    assert "gaussian bytes" in capsys.readouterr().out


def test_info_states_the_method_and_its_codes(built, capsys):
    assert cli.main(["info", str(built), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["method"], facts["codes"], facts["dino"]) == ("averaged", 16, "not used")
    assert "weight_dropped" not in facts


def test_ground_truth_that_is_given_and_missing_ends_in_one_line(built, tmp_path, capsys):
    fails_in_one_line(capsys, ["evaluate", str(built), "--masks", str(tmp_path / "nowhere")], "nowhere")
