"""Write the documentation and the published demo as one static site, for GitHub Pages or any web server.

    make site      # or: python tools/write_site.py output/site

Starts at README.md and follows the links: Markdown becomes HTML, other files are copied. A link that leads nowhere
is an error. markdown-it-py comes with rich.
"""

from __future__ import annotations

import html
import re
import shutil
import sys
import tempfile
from pathlib import Path
from urllib.parse import unquote, urlsplit

from markdown_it import MarkdownIt
from markdown_it.token import Token

ROOT = Path(__file__).parents[1]
PAGES = (
    "README.md", "docs/captures.md", "docs/selection.md", "docs/viewer.md", "docs/publishing.md", "docs/library.md",
    "docs/formats.md", "docs/api.md", "docs/mcp.md", "docs/method.md", "docs/paper.md", "docs/scaling.md",
    "docs/evaluation.md",
    "docs/results.md", "docs/architecture.md", "docs/conventions.md", "SECURITY.md", "CONTRIBUTING.md",
    "CHANGELOG.md",
)  # fmt: skip
"""The pages of the menu; others are reached by links."""
DEMO = "demo"
"""Folder of the published demo within the site."""

STYLE = """
:root { color-scheme: light dark; --line: light-dark(#d9dde3, #33373f); --soft: light-dark(#f3f5f7, #1f2228); }
body { margin: 0; font: 16px/1.6 system-ui, sans-serif; display: grid; grid-template-columns: 210px minmax(0, 1fr); }
nav { padding: 24px 18px; border-right: 1px solid var(--line); min-height: 100vh; }
nav a { display: block; padding: 2px 0; text-decoration: none; }
nav a[aria-current] { font-weight: 650; }
main { max-width: 860px; padding: 12px 32px 64px; }
img { max-width: 100%; }
pre { overflow-x: auto; padding: 12px 16px; background: var(--soft); border-radius: 8px; }
code { font-size: 0.92em; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: 0.93em; }
th, td { border: 1px solid var(--line); padding: 5px 10px; text-align: left; vertical-align: top; }
@media (max-width: 720px) {
  body { display: block; } nav { min-height: 0; border: 0; } main { padding: 0 18px 48px; }
}
"""


class Site:
    """Turns files of the repository into a site, following their links.

    Args:
        output: The folder to write.
    """

    def __init__(self, output: Path) -> None:
        self.output = output
        self.markdown = MarkdownIt("commonmark", {"html": True}).enable(["table", "strikethrough"])
        self.anchors: dict[Path, set[str]] = {}
        self.asked: list[tuple[Path, Path, str]] = []
        """Links to anchors: from which page, to which file, which anchor."""

    def write(self) -> list[Path]:
        """Write all pages; returns the files they were made from.

        Raises:
            SystemExit: If a link leads nowhere.
        """
        waiting, done = [ROOT / page for page in PAGES], []
        while waiting:
            path = waiting.pop()
            if path in done:
                continue
            done.append(path)
            target = self.output / self._address(path)
            target.parent.mkdir(parents=True, exist_ok=True)
            if path.is_dir():
                names = sorted(child.name for child in path.iterdir() if child.is_file())
                waiting += [path / name for name in names]
                entries = "".join(f'<li><a href="{html.escape(n)}">{html.escape(n)}</a></li>' for n in names)
                self._write_page(path, path.name, f"<h1>{html.escape(path.name)}</h1><ul>{entries}</ul>")
            elif path.suffix == ".md":
                tokens = self.markdown.parse(path.read_text(encoding="utf-8"))
                waiting += self._connect(tokens, path)
                body = self.markdown.renderer.render(tokens, self.markdown.options, {})
                body = body.replace("<table>", '<div class="wide"><table>').replace(
                    "</table>", "</table></div>"
                )
                title = next(t.content for n, t in enumerate(tokens) if tokens[n - 1].type == "heading_open")
                self._write_page(path, title, body)
            else:
                shutil.copyfile(path, target)
        for page, file, anchor in self.asked:
            if anchor not in self.anchors.get(file, set()):
                raise SystemExit(
                    f"{page.relative_to(ROOT)}: no heading #{anchor} in {file.relative_to(ROOT)}"
                )
        return done

    def _address(self, path: Path) -> Path:
        relative = path.relative_to(ROOT)
        if path.is_dir():
            return relative / "index.html"
        if relative == Path("README.md"):
            return Path("index.html")
        return relative.with_suffix(".html") if path.suffix == ".md" else relative

    def _connect(self, tokens: list[Token], page: Path) -> list[Path]:
        """Give headings their anchors, point links to the site, and return the files that are linked."""
        linked, known = [], self.anchors.setdefault(page, set())
        for place, token in enumerate(tokens):
            if token.type == "heading_open":
                words = re.sub(r"[^\w\- ]", "", tokens[place + 1].content.lower()).replace(" ", "-")
                token.attrSet("id", words)
                known.add(words)
            for child in token.children or ():
                name = {"link_open": "href", "image": "src"}.get(child.type, "")
                address = urlsplit(str(child.attrGet(name) or ""))
                if not name or address.scheme:
                    continue
                target = (page.parent / unquote(address.path)).resolve() if address.path else page
                if not target.exists() or ROOT not in (target, *target.parents):
                    raise SystemExit(f"{page.relative_to(ROOT)}: a link leads nowhere: {child.attrGet(name)}")
                if address.fragment:
                    self.asked.append((page, target, address.fragment))
                anchor = f"#{address.fragment}" if address.fragment else ""
                child.attrSet(name, self._relative(page, self._address(target)) + anchor)
                linked.append(target)
        return linked

    def _relative(self, page: Path, address: Path) -> str:
        up = "../" * (len(self._address(page).parts) - 1)
        return f"{up}{address.as_posix()}"

    def _write_page(self, path: Path, title: str, body: str) -> None:
        menu = [(self._address(ROOT / page), Path(page).stem.lower()) for page in PAGES]
        menu[0] = (menu[0][0], "lexsplat")
        menu.insert(1, (Path(DEMO) / "index.html", "demo in the browser"))
        own = self._address(path)
        links = "".join(
            f'<a href="{self._relative(path, address)}"{" aria-current=page" if address == own else ""}>{name}</a>'
            for address, name in menu
        )
        text = (
            f'<!doctype html>\n<html lang="en">\n<meta charset="utf-8">\n<title>{html.escape(title)}</title>\n'
            f'<meta name="viewport" content="width=device-width, initial-scale=1">\n<style>{STYLE}</style>\n'
            f"<body>\n<nav>{links}</nav>\n<main>\n{body}</main>\n</body>\n</html>\n"
        )
        (self.output / own).write_text(text, encoding="utf-8")


def main() -> None:
    """Write the site; an earlier one is replaced when the new one is whole."""
    from lexsplat import open_scene
    from lexsplat.scenes.folder import BUNDLED_SCENE
    from lexsplat.scenes.publishing import PublishOptions, publish

    output = Path(sys.argv[1])
    if output.exists() and not (output / DEMO / "manifest.json").exists():
        raise SystemExit(
            f"{output}: expected a new folder or an earlier site, found other files; give another name"
        )
    output.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{output.name}.", dir=output.parent) as work:
        whole = Path(work) / "site"
        pages = Site(whole).write()
        publish(open_scene(BUNDLED_SCENE), whole / DEMO, PublishOptions(title="A table top"))
        shutil.rmtree(output, ignore_errors=True)
        whole.rename(output)
    print(
        f"{output}: {len(pages)} files and the demo; open it with: python -m http.server --directory {output}"
    )


if __name__ == "__main__":
    main()
