"""``index.html`` of a page, and the files of its bundle. The bundle is built from ``web/``."""

from __future__ import annotations

import base64
import hashlib
import html
from collections.abc import Mapping
from importlib.resources import files
from typing import Any

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

PAGE_FILES = ("page.js", "page.wasm", "page.css", "LICENSES.txt")
_POLICY = (
    "default-src 'none'; script-src {script} 'wasm-unsafe-eval'; style-src {style}; img-src {images} data: blob:; "
    "connect-src {connect}; worker-src blob:; base-uri 'none'; form-action 'none'"
)


def page_file(name: str) -> bytes:
    """A file of the bundle."""
    return files(__package__).joinpath("page", name).read_bytes()


def folder_index(manifest: Mapping[str, Any]) -> str:
    """``index.html`` of a page whose files lie beside it."""
    own = "'self'"
    policy = _POLICY.format(script=own, style=own, connect=own, images=own)
    needed = ("manifest.json", "page.wasm", html.escape(manifest["scene"]["file"]))
    ahead = "\n".join(f'<link rel="preload" href="{name}" as="fetch" crossorigin>' for name in needed)
    style = f'<link rel="stylesheet" href="page.css">\n{ahead}'
    return _index(manifest, policy, style, '<script src="page.js" defer></script>')


def single_index(manifest: Mapping[str, Any], style: str, script: str, blocks: str) -> str:
    """The page as one file, with its data in ``blocks``."""
    policy = _POLICY.format(script=_source(script), style=_source(style), connect="'none'", images="")
    return _index(manifest, policy, f"<style>{style}</style>", f"{blocks}\n<script>{script}</script>")


def _index(manifest: Mapping[str, Any], policy: str, style: str, script: str) -> str:
    """The filled template; everything in it that others wrote is escaped."""
    page = Environment(autoescape=True, undefined=StrictUndefined, keep_trailing_newline=True)
    return page.from_string(page_file("index.html").decode()).render(
        POLICY=policy,
        TITLE=manifest["title"],
        DESCRIPTION=manifest["description"] or f"Search {manifest['title']} with words.",
        STYLE=Markup(style),
        SCRIPT=Markup(script),
    )


def _source(content: str) -> str:
    """The source expression of a content security policy that admits one inline element."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()}'"
