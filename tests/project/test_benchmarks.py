"""Benchmarks are run by hand and rarely: that they still fit the package is found out here."""

import json
import runpy
import sys
from pathlib import Path

import pytest

BENCHMARKS = [
    script
    for script in sorted((Path(__file__).parents[2] / "benchmarks").glob("*.py"))
    if "__main__" in script.read_text()
]


@pytest.mark.parametrize("script", BENCHMARKS, ids=lambda script: script.name)
def test_a_benchmark_explains_itself(script, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [str(script), "--help"])
    monkeypatch.syspath_prepend(str(script.parent))
    with pytest.raises(SystemExit) as stop:
        runpy.run_path(str(script), run_name="__main__")
    assert stop.value.code == 0
    assert "usage:" in capsys.readouterr().out


def test_the_benchmark_of_frames_measures_on_a_cpu_too(monkeypatch, tmp_path, capsys):
    monkeypatch.syspath_prepend(str(BENCHMARKS[0].parent))
    import gpu

    monkeypatch.setattr(gpu, "RESULTS", tmp_path)
    arguments = ["gpu.py", "--device", "cpu", "--counts", "300", "--size", "32x24", "--seconds", "0.05"]
    monkeypatch.setattr(sys, "argv", arguments)
    gpu.main()
    assert "synthetic 300" in capsys.readouterr().out
    (record,) = tmp_path.glob("gpu_*.json")
    rates = json.loads(record.read_text())["rows"][0]
    assert all(rates[name] > 0 for name in ("rgb", "prompt", "paper", "training", "memory"))
