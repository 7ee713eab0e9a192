"""Benchmarks run by hand and rarely; these tests check that they fit the package."""

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
def test_every_benchmark_has_help(script, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [str(script), "--help"])
    monkeypatch.syspath_prepend(str(script.parent))
    with pytest.raises(SystemExit) as stop:
        runpy.run_path(str(script), run_name="__main__")
    assert stop.value.code == 0
    assert "usage:" in capsys.readouterr().out


def test_the_gpu_benchmark_runs_on_a_cpu_and_records_its_conditions(monkeypatch, tmp_path, capsys):
    monkeypatch.syspath_prepend(str(BENCHMARKS[0].parent))
    import gpu

    path = tmp_path / "benchmark_gpu.json"
    arguments = ["--device", "cpu", "--counts", "300", "--size", "32x24", "--seconds", "0.05"]
    monkeypatch.setattr(sys, "argv", ["/some/folder/gpu.py", *arguments, "--json", str(path)])
    gpu.main()
    assert "synthetic 300" in capsys.readouterr().out
    record = json.loads(path.read_text())
    assert record["command"].startswith("python benchmarks/gpu.py --device cpu --counts 300")
    assert record["commit"]
    assert record["machine"]["cores"] >= 1
    rates = record["rows"][0]
    assert all(rates[name] > 0 for name in ("rgb", "prompt", "paper", "training", "memory"))
