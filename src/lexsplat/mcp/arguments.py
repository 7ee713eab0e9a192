"""Errors in the arguments of a call: the argument, the expected value, the value found, and a remedy."""

from __future__ import annotations

import difflib
import math
import re
import reprlib
from collections.abc import Iterable, Mapping
from typing import Any

from pydantic import ValidationError

from lexsplat.queries.patterns import RELATIONS
from lexsplat.runtime.errors import QueryError

NOT_BLANK = r"\S"
"""The pattern of a text that names something."""
_KINDS = {
    "string": "text",
    "number": "a number",
    "integer": "a whole number",
    "boolean": "true or false",
    "null": "null",
}
_SHOWN = 60

Schema = Mapping[str, Any]


def check_names(what: str, name: str, arguments: Mapping[str, Any], schemas: Mapping[str, Schema]) -> None:
    """Refuse a name that is not offered, and arguments that it does not take or needs.

    Args:
        what: Kind of the name: "tool" or "prompt".
        name: Its name.
        arguments: Its arguments.
        schemas: The schema of the arguments of each name that is offered.

    Raises:
        QueryError: With the nearest name as its remedy.
    """
    if name not in schemas:
        expected = f"one of {', '.join(schemas)}"
        found = f"no {what} of this name"
        raise QueryError(
            f"{what} {_shown(name)}", expected=expected, found=found, remedy=nearest(name, schemas)
        )
    known = schemas[name]["properties"]
    missing = [key for key in schemas[name].get("required", []) if key not in arguments]
    for unknown in sorted(arguments.keys() - known.keys()):
        raise QueryError(
            f"argument {_shown(unknown)}",
            expected=f"one of {', '.join(known)}" if known else "no arguments",
            found=f"one that {name} does not take",
            remedy=nearest(unknown, missing) or nearest(unknown, known, "leave it out"),
        )
    if missing:
        raise QueryError(
            ", ".join(missing),
            expected=f"a value in {name}({', '.join(known)})",
            found="none",
            remedy=_described(missing[0], known[missing[0]]),
        )
    for key, value in arguments.items():  # numbers would be made of them
        if "boolean" in str(known[key]):
            continue
        if isinstance(value, bool):
            raise _wrong(key, known[key], value)
        for place, each in enumerate(value if isinstance(value, list) and "items" in known[key] else ()):
            if isinstance(each, bool):
                raise _wrong(key, known[key], each, [place])


def wrong_value(error: ValidationError, schema: Schema) -> QueryError:
    """The first argument whose value does not fit the schema of the arguments."""
    first = error.errors(include_url=False, include_context=False)[0]
    key, *places = first["loc"]
    return _wrong(
        str(key), schema["properties"][key], first["input"], [p for p in places if isinstance(p, int)]
    )


def nearest(name: str, names: Iterable[str], otherwise: str = "") -> str:
    """A remedy: the name that is meant."""
    names = list(names)
    for words, relation in RELATIONS:
        if relation in names and re.fullmatch(words, name.strip().lower()):
            return f"did you mean {relation!r}?"
    close = difflib.get_close_matches(name[:_SHOWN].lower(), list(names), n=1)
    return f"did you mean {close[0]!r}?" if close else otherwise


def _wrong(key: str, schema: Schema, value: Any, places: Iterable[int] = ()) -> QueryError:
    subject, part = key, schema
    for place in places:
        subject, part = f"{subject}[{place}]", part["items"]
    remedy = nearest(value, part["enum"]) if isinstance(value, str) and "enum" in part else ""
    expected, found = _kind(part), _shown(value)
    if isinstance(value, str) and not value.strip():
        found = "an empty text"
    elif isinstance(value, str) and len(value) > part.get("maxLength", math.inf):
        expected, found = f"at most {part['maxLength']} characters", str(len(value))
    return QueryError(subject, expected=expected, found=found, remedy=remedy or _described(key, schema))


def _kind(schema: Schema) -> str:
    """The values that a schema admits, in words."""
    if "enum" in schema:
        return f"one of {', '.join(schema['enum'])}"
    if "anyOf" in schema:
        return " or ".join(_kind(each) for each in schema["anyOf"])
    if schema["type"] == "array":
        most = f" of at most {schema['maxItems']}" if "maxItems" in schema else ""
        return f"a list{most}, each {_kind(schema['items'])}"
    kind = "a word or phrase" if schema.get("pattern") == NOT_BLANK else _KINDS[schema["type"]]
    if "minimum" in schema:
        return f"{kind} in {schema['minimum']}..{schema['maximum']}"
    return kind


def _described(key: str, schema: Schema) -> str:
    description = schema.get("description", "").rstrip(".")
    return f"{key} is: {description}" if description else ""


def _shown(value: Any) -> str:
    """A value in at most about 60 characters of one line, however large or deep it is."""
    if value is None or isinstance(value, bool):
        return str(value).lower().replace("none", "null")
    return repr(value[:_SHOWN]) if isinstance(value, str) else reprlib.repr(value)[:_SHOWN]
