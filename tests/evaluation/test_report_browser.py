"""The report is readable in a real browser, wide and narrow."""

from collections.abc import Iterator
from typing import Any

import pytest
from support.page_browser import CHROMIUM
from support.report_pages import evaluated

from lexsplat.evaluation.report import MeasuredMethod, write_comparison, write_report

VERSIONS = {f"package{number}": f"{number}.0.0+local.build" for number in range(12)}

pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on the path")]


@pytest.fixture(scope="module")
def reports(tmp_path_factory):
    """The report of a scene and that of a comparison."""
    folder = tmp_path_factory.mktemp("reports")
    metrics, gallery = evaluated()
    metrics.machine["versions"] = VERSIONS
    write_report(folder / "report.html", metrics, gallery)
    curves = {prompt: list(curve) for prompt, curve in metrics.curves.items()}
    methods = [
        MeasuredMethod(name, [metrics.to_json()] * 2, curves, gallery=gallery)
        for name in ("averaged", "trained-feature", "dff", "lerf", "3dovs", "nearest")
    ]
    write_comparison(folder / "comparison.html", methods, "compare", config={}, machine=metrics.machine)
    return folder


@pytest.fixture(scope="module", params=[1280, 400])
def opened(request, browser, reports) -> Iterator[Any]:
    """The report in a window of some width; failed requests and console messages are in ``refused``."""
    page = browser.new_page(viewport={"width": request.param, "height": 800})
    page.refused = []
    page.on("console", lambda message: page.refused.append(message.text))
    page.on("requestfailed", lambda request: page.refused.append(request.url))
    page.goto((reports / "report.html").as_uri())
    yield page
    page.close()


def test_the_page_is_no_wider_than_its_window_and_requests_nothing(opened):
    assert opened.evaluate("document.documentElement.scrollWidth <= innerWidth")
    assert opened.refused == []


def test_settings_and_costs_can_be_read_without_scrolling_sideways(opened):
    edges = opened.evaluate(
        "[...document.querySelectorAll('.facts td')].map(cell => cell.getBoundingClientRect().right)"
    )
    assert len(edges) > 20
    assert max(edges) <= opened.viewport_size["width"]


def test_images_of_a_case_are_large_enough(opened):
    widths = opened.evaluate(
        "[...document.querySelectorAll('.case img, .case .pic')].map(p => p.getBoundingClientRect().width)"
    )
    assert widths
    assert min(widths) >= 120


def test_a_comparison_is_no_wider_than_its_window_and_requests_nothing(opened, reports):
    opened.goto((reports / "comparison.html").as_uri())
    assert opened.evaluate("document.documentElement.scrollWidth <= innerWidth")
    assert opened.evaluate("document.querySelectorAll('.versus .answer').length") == 6 * 6
    assert opened.refused == []
