"""The Python of README.md and of the pages about the API runs on the bundled scene."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = ("README.md", "docs/api.md", "docs/selection.md")
FILES_OF_A_USER = ("photos", "myscene", "rooms", "my_features")
"""Names in the blocks that need a capture, a scene or a library of the reader; these are only compiled."""

pytestmark = pytest.mark.slow


def blocks(page: str) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", (ROOT / page).read_text(encoding="utf-8"), re.DOTALL | re.M)


@pytest.mark.parametrize("page", PAGES)
def test_the_python_of_a_page_runs_in_its_order_on_the_bundled_scene(page, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(
        'import lexsplat\nfrom pathlib import Path\nscene = lexsplat.open_scene("demo", device="cpu")', names
    )
    ran = 0
    for number, block in enumerate(blocks(page), start=1):
        code = compile(block, f"{page}, block {number}", "exec")
        if not any(f'"{name}"' in block for name in FILES_OF_A_USER):
            exec(code, names)
            ran += 1
    assert ran, f"no block of {page} ran"


def test_every_member_that_the_api_page_lists_exists():
    import lexsplat

    text = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    scene = lexsplat.open_scene("demo", device="cpu")
    objects = {"Scene": scene, "Selection": scene.select("red apple"), "open_library": lexsplat.Library}
    for heading, value in objects.items():
        section = text.split(f"\n## {heading}\n", 1)[1].split("\n## ", 1)[0]
        rows = [row.split("|")[1] for row in section.splitlines() if re.match(r"\| `", row)]
        cells = [cell for row in rows for cell in re.findall(r"`([a-z_]+)(?:\([^`]*\))?`", row)]
        members = [cell for cell in cells if cell not in ("feature_map", "feature_picture", "len")]
        assert len(members) > 2, heading
        assert [name for name in members if not hasattr(value, name)] == [], heading
