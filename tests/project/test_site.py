"""The static site: every link of the documentation leads somewhere."""

import re
import runpy
from pathlib import Path

import pytest

TOOL = Path(__file__).parents[2] / "tools" / "write_site.py"


@pytest.fixture
def site():
    return runpy.run_path(str(TOOL))


@pytest.mark.slow
def test_every_page_is_written_and_every_link_within_the_site_leads_to_a_file(site, tmp_path):
    site["Site"](tmp_path).write()
    for name in site["PAGES"]:
        page = "index.html" if name == "README.md" else name.replace(".md", ".html")
        assert (tmp_path / page).exists(), page
    checked = 0
    for page in tmp_path.rglob("*.html"):
        for link in re.findall(r'(?:href|src)="([^"#:]+)"', page.read_text()):
            if not link.startswith(("demo/", "../demo/", "../../demo/", "../../../../demo/")):
                assert (page.parent / link).exists(), f"{page.name}: {link}"
                checked += 1
    assert checked > 100


@pytest.mark.parametrize("link", ["nowhere.md", "selection.md#no-such-heading", "../../outside.md"])
def test_a_link_that_leads_nowhere_is_an_error(site, tmp_path, link):
    folder = tmp_path / "repository"
    (folder / "docs").mkdir(parents=True)
    for name in site["PAGES"]:
        (folder / name).write_text(f"# {name}\n")
    (folder / "docs" / "viewer.md").write_text(f"# Viewer\n\n[link]({link})\n")
    site["Site"].write.__globals__["ROOT"] = folder
    with pytest.raises(SystemExit, match=r"docs/viewer\.md"):
        site["Site"](tmp_path / "site").write()


@pytest.mark.slow
def test_a_site_that_cannot_be_finished_leaves_the_earlier_one_as_it_was(site, tmp_path, monkeypatch):
    def fail(*arguments):
        raise RuntimeError("disk full")

    earlier = tmp_path / "site" / "demo" / "manifest.json"
    earlier.parent.mkdir(parents=True)
    earlier.write_text("{}")
    monkeypatch.setattr("lexsplat.scenes.publishing.publish", fail)
    monkeypatch.setattr("lexsplat.open_scene", lambda name: None)
    monkeypatch.setattr("sys.argv", ["write_site.py", str(tmp_path / "site")])
    with pytest.raises(RuntimeError, match="disk full"):
        site["main"]()
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == [earlier]


def test_the_menu_has_every_page_of_docs(site):
    docs = {f"docs/{path.name}" for path in (TOOL.parents[1] / "docs").glob("*.md")}
    assert docs <= set(site["PAGES"])
