"""From the words of a command line to a command: tyro with short help pages and plain placeholders.

A command class may have these attributes in addition to its fields:

- ``essential``: names of the settings of a build that ``--help`` shows; ``--help-all`` shows the others, too;
- ``rare``: names of the command's own options that only ``--help-all`` shows;
- ``unused``: names of the settings that the command accepts and ignores, which no help page shows;
- ``defaults``: help texts of options whose default is None or empty, in place of those in `_DEFAULTS`;
- ``synonyms``: other spellings of options;
- ``elsewhere``: options of another command, with the command that has them.

Its method ``check``, if it has one, raises ValueError for options that are invalid together.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import inspect
import io
import operator
import re
import shutil
import sys
import textwrap
import types
from collections.abc import Sequence
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin, get_type_hints

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

HELP = ("-h", "--help")
HELP_ALL = "--help-all"
ESSENTIAL_SETTINGS = (
    "clip", "dino", "device", "method", "as_in_paper", "iterations", "downscale", "test_every", "seed", "memory",
    "workers", "blocks",
)  # fmt: skip
"""Settings of a build that people use."""
MEASURED_SETTINGS = tuple(
    name for name in ESSENTIAL_SETTINGS if name not in ("method", "as_in_paper", "test_every", "workers")
)
"""Those that people use to measure methods, which are options of their own there."""

_PLACEHOLDERS = {
    "title": "TEXT",
    "description": "TEXT",
    "start_view": "VIEW",
    "ground_truth": "FOLDER",
    "clip": "NAME", "dino": "NAME", "view": "NAME", "test_views": "NAME", "name": "NAME", "host": "ADDRESS",
    "select": "PHRASE", "height_of": "PHRASE", "between": "PHRASE PHRASE", "negatives": "PHRASE",
    "workers": "none|ray|ray://HOST:PORT", "blocks": "auto|N|none",
    "template": "SENTENCE", "points": "X,Y,Z X,Y,Z", "up": "X,Y,Z", "memory": "SIZE",
}  # fmt: skip
"""Placeholders by name of option; that of an option with any number of values is followed by an ellipsis."""
_DEFAULTS = {
    "clip": "the encoder of the build",
    "view": "what most of the views that show both things say",
    "threshold": "chosen for each phrase",
    "ground_truth": "the ground truth in the capture or beside it",
    "prompt_list": "the prompts of the ground truth",
    "downscale": "chosen for the device",
    "iterations": "chosen for the device",
    "up": "from the cameras",
    "averaged.dino": "by the tokens of CLIP",
}
"""Help texts by name of option, for options whose default is None or empty.

Names of the settings of a part begin with the name of the part.
"""

_RENAMED = {
    "--averaging.": "--averaged.",
    "--embedding.": "--trained.",
    "normalise-rendering": "normalize-rendering",
    "normalise_rendering": "normalize_rendering",
}
"""Parts of options in earlier versions, and their present names; `scenes.records` has those of scene folders."""

CommandT = TypeVar("CommandT")
REGISTRY = ConstructorRegistry()


def parse(command: type[CommandT], name: str, words: Sequence[str]) -> CommandT:
    """Parse the words behind the name of a command.

    Raises:
        SystemExit: With status 2 after wrong usage, with status 0 after help.
    """
    program = f"lexsplat {name}"
    words = [_in_our_spelling(word, getattr(command, "synonyms", {})) for word in words]
    for option, other in getattr(command, "elsewhere", {}).items():
        if any(word.partition("=")[0] == option for word in words):
            print(f"error: {program} has no {option}; use: {other}", file=sys.stderr)
            raise SystemExit(2)
    if HELP_ALL in words:
        _print_help(command, program, set(getattr(command, "unused", ())))
    if any(word in HELP for word in words):
        _print_help(command, program, _not_essential(command))
    try:
        parsed = _parsed(command, program, words)
        _refuse_replaced(getattr(parsed, "settings", None), words)
        if hasattr(parsed, "check"):
            parsed.check()
        return parsed
    except ValueError as error:  # raised by the checks of a command or of its settings
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None


def _parsed(command: type[CommandT], program: str, words: Sequence[str]) -> CommandT:
    """The command; errors name the help page that lists every option, and no default of "none"."""
    whole = HELP_ALL if _not_essential(command) else HELP[-1]
    written = io.StringIO()
    try:
        with contextlib.redirect_stderr(written):
            return tyro.cli(command, prog=program, args=words, registry=REGISTRY)
    finally:
        # What is replaced keeps its length, so that the panel keeps its width.
        page, nothing = rf"For full helptext, (run|see) {program} --help", r"\(default:[\s│]*none\)"
        all_options = f"All options: {program} {whole}"
        text = re.sub(page, lambda found: all_options.ljust(len(found.group())), written.getvalue())
        text = re.sub(nothing, lambda found: re.sub(r"[^\s│]", " ", found.group()), text)
        text = re.sub(r"(?m)^(.*`.*?)(\S*)$", _without_code_marks, text)
        if not sys.stderr.isatty():  # tyro asks standard output
            text = re.sub(r"\x1b\[[\d;]*m", "", text)
        print(text, end="", file=sys.stderr)


def _refuse_replaced(settings: Any, words: Sequence[str]) -> None:
    """Refuse given settings in whose place ``--as-in-paper`` takes others.

    The settings themselves take a value that equals its default for one that was not given.

    Raises:
        ValueError: If there is one.
    """
    if not getattr(settings, "as_in_paper", False):
        return
    taken = settings.spelled_out()
    for option in (word.partition("=")[0] for word in words if word.startswith("--")):
        *parts, name = option.removeprefix("--").replace("-", "_").split(".")
        path = operator.attrgetter(".".join((*parts, name.removeprefix("no_"))))
        with contextlib.suppress(AttributeError):  # an option of the command, not of the settings
            found, expected = path(settings), path(taken)
            if found != expected:
                raise ValueError(
                    f"{option}: expected {expected}, for which --as-in-paper stands, found {found}; "
                    f"leave {option} or --as-in-paper out"
                )


def _without_code_marks(line: re.Match[str]) -> str:
    return line[1].replace("`", "").ljust(len(line[1])) + line[2]


def _in_our_spelling(word: str, synonyms: dict[str, str]) -> str:
    option, equals, value = word.partition("=")
    option = synonyms.get(option, option)
    if option.startswith("--"):
        for former, present in _RENAMED.items():
            option = option.replace(former, present)
    return option + equals + value


def _not_essential(command: type) -> set[str]:
    """Names of the fields, of a command and of its settings, that the short help page leaves out."""
    rare = set(getattr(command, "rare", ()))
    essential = getattr(command, "essential", None)
    settings = _settings_class(command)
    if essential is None or settings is None:
        return rare
    return rare | {field.name for field in dataclasses.fields(settings)} - set(essential)


def _settings_class(command: type) -> type | None:
    hint = get_type_hints(command).get("settings")
    return hint if inspect.isclass(hint) and dataclasses.is_dataclass(hint) else None


def _print_help(command: type, program: str, hidden: set[str]) -> None:
    """Print a help page without the given settings and end the program."""
    print(_description(command), end="\n\n")
    try:
        tyro.cli(
            _help_page(command, hidden, getattr(command, "defaults", {})),
            prog=program,
            description="",  # tyro would reflow it
            args=["--help"],
            config=(tyro.conf.FlagCreatePairsOff,),
            registry=REGISTRY,
        )
    finally:
        if hidden - set(getattr(command, "unused", ())):
            print(f"More options: {program} {HELP_ALL}")


def _description(command: type) -> str:
    """The text of a docstring before its arguments, wrapped; indented blocks stay as they are."""
    width = min(shutil.get_terminal_size().columns, 80)
    blocks = (inspect.getdoc(command) or "").split("\nArgs:")[0].strip().split("\n\n")
    return "\n\n".join(block if block.startswith(" ") else textwrap.fill(block, width) for block in blocks)


def _help_page(kind: type, hidden: set[str], defaults: dict[str, str], part: str = "") -> type:
    """A dataclass of the same name for help only: fields suppressed, placeholders and defaults in words.

    Args:
        kind: A command, its settings, or a part of them.
        hidden: Names of the fields to suppress.
        defaults: Defaults in words.
        part: Prefix of the options of a part, such as "averaged.".
    """
    hints = get_type_hints(kind, include_extras=True)
    fields = []
    for field in dataclasses.fields(kind):
        hint = hints[field.name]
        default: Any = field.default
        factory: Any = field.default_factory
        if factory is not dataclasses.MISSING and dataclasses.is_dataclass(example := factory()):
            is_whole = field.name == "settings"
            inner = hidden if is_whole else set()
            page = _help_page(type(example), inner, {}, "" if is_whole else f"{field.name}.")
            # As `settings.Settings`, whose options have no name in front.
            hint = Annotated[page, tyro.conf.arg(name="")] if is_whole else page
            default, factory = dataclasses.MISSING, functools.partial(_filled, page, example)
        else:
            hint = _with_words(part + field.name, hint, default, defaults)
        if field.name in hidden:
            hint = Annotated[hint, tyro.conf.Suppress]
        fields.append(
            (
                field.name,
                hint,
                dataclasses.field(default=default, default_factory=factory, kw_only=field.kw_only),
            )
        )
    frozen = kind.__dataclass_params__.frozen  # type: ignore[attr-defined]
    page = dataclasses.make_dataclass(kind.__name__, fields, bases=(kind,), frozen=frozen)
    page.__doc__ = _arguments_section(kind)
    return page


def _arguments_section(kind: type) -> str:
    """The arguments of the docstrings of a class and its bases, one line each, without code marks."""
    docs = [inspect.cleandoc(vars(base).get("__doc__") or "") for base in kind.__mro__[:-1]]
    sections = [doc.partition("\nArgs:\n")[2].partition("\n\n")[0] for doc in docs]
    return "Options.\n\nArgs:\n" + re.sub(r"\n {8,}", " ", "\n".join(filter(None, sections))).replace("`", "")


def _filled(page: type, example: Any) -> Any:
    """A page with the values of an example; its parts are pages, too."""
    values = {}
    for field in dataclasses.fields(page):
        value = getattr(example, field.name)
        if dataclasses.is_dataclass(value):
            value = _filled(type(field.default_factory()), value)  # type: ignore[operator]
        values[field.name] = value
    return page(**values)


def _with_words(name: str, hint: Any, default: Any, defaults: dict[str, str]) -> Any:
    """A type with placeholder and default in words, where it has none of its own."""
    kind, *own = get_args(hint) if get_origin(hint) is Annotated else (hint,)
    # In front: tyro takes the last one given.
    return Annotated[(kind, _in_words(name, kind, default, defaults), *own)]  # type: ignore[return-value]


def _in_words(name: str, kind: Any, default: Any, defaults: dict[str, str]) -> Any:
    hint, placeholder = None, _PLACEHOLDERS.get(name)
    if placeholder and get_origin(kind) is tuple and Ellipsis in get_args(kind):
        placeholder += " ..."
    if default is None or default in ((), ""):
        words = {**_DEFAULTS, **defaults}
        hint = f"(default: {words.get(name, 'none')})"
    elif default is False or default is True:
        hint = ""
    return tyro.conf.arg(metavar=placeholder, help_behavior_hint=hint)


@REGISTRY.primitive_rule
def _number(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    """Numbers, refused in plain words."""
    kind = info.type
    if kind not in (int, float):
        return None
    expected = "a whole number" if kind is int else "a number"

    def read(words: list[str]) -> Any:
        try:
            return kind(words[0])
        except ValueError:
            raise ValueError(f"expected {expected}, found {words[0]!r}") from None

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=kind.__name__.upper(),
        instance_from_str=read,
        is_instance=lambda value: isinstance(value, (int, float)),
        str_from_instance=lambda value: [str(value)],
    )


@REGISTRY.primitive_rule
def _text(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    """``TEXT`` in place of ``STR`` where an option has no placeholder of its own."""
    if info.type is not str:
        return None
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="TEXT",
        instance_from_str=lambda words: words[0],
        is_instance=lambda value: isinstance(value, str),
        str_from_instance=lambda value: [value],
    )


@REGISTRY.primitive_rule
def _optional(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    """``FLOAT`` in place of ``{None}|FLOAT``; the word None stays accepted."""
    options = get_args(info.type)
    if (
        get_origin(info.type) not in (Union, types.UnionType)
        or len(options) != 2
        or type(None) not in options
    ):
        return None
    inner = _spec(next(option for option in options if option is not type(None)), info)
    if inner is None:
        return None
    spec = inner
    return dataclasses.replace(
        spec,
        choices=None if spec.choices is None else (*spec.choices, "None"),
        instance_from_str=lambda words: None if words == ["None"] else spec.instance_from_str(words),
        is_instance=lambda value: value is None or spec.is_instance(value),
        str_from_instance=lambda value: ["none"] if value is None else spec.str_from_instance(value),
    )


@REGISTRY.primitive_rule
def _several(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    """``TEXT ...`` in place of ``[TEXT [TEXT ...]]``, "none" in place of nothing."""
    arguments = get_args(info.type)
    if get_origin(info.type) is not tuple or len(arguments) != 2 or arguments[1] is not Ellipsis:
        return None
    spec = _spec(arguments[0], info)
    if spec is None or spec.nargs != 1:
        return None
    return PrimitiveConstructorSpec(
        nargs="*",
        metavar=f"{spec.metavar} ...",
        instance_from_str=lambda words: tuple(spec.instance_from_str([word]) for word in words),
        is_instance=lambda values: isinstance(values, tuple) and all(map(spec.is_instance, values)),
        str_from_instance=lambda values: [w for v in values for w in spec.str_from_instance(v)] or ["none"],
        choices=spec.choices,
    )


def _spec(kind: Any, info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    spec = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(kind, set(info.markers)))
    return spec if isinstance(spec, PrimitiveConstructorSpec) else None
