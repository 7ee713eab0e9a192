"""The JSON Schemas of docs/schemas, and a check of documents against them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from jsonschema import Draft202012Validator

SCHEMAS = Path(__file__).parents[2] / "docs" / "schemas"


def validated(name: str, document: Any) -> None:
    """Fails with every place in which a document differs from ``docs/schemas/NAME.json``."""
    schema = json.loads((SCHEMAS / f"{name}.json").read_text())
    errors = [
        f"{error.json_path}: {error.message}" for error in Draft202012Validator(schema).iter_errors(document)
    ]
    assert not errors, errors
