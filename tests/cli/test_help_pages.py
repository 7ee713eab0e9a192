"""Help pages of the command line: options, placeholders and defaults."""

import os
import re

import pytest

from lexsplat import cli

PAGES: dict[tuple, str] = {}
"""Pages by their words and width, each made once: a long one takes a quarter of a second."""


def help_page(capsys, *arguments: str) -> str:
    key = (*arguments, os.environ.get("COLUMNS"))
    if key not in PAGES:
        with pytest.raises(SystemExit) as ended:
            cli.main([*arguments])
        assert ended.value.code == 0
        PAGES[key] = capsys.readouterr().out
    return PAGES[key]


def options_of(page: str) -> set[str]:
    """The options that start a line of a help page, with or without a frame."""
    lines = (line.strip("│ ") for line in page.splitlines())
    return {word for line in lines if line.startswith("-") for word in re.findall(r"--[\w.-]*\w", line)}


@pytest.mark.slow
@pytest.mark.parametrize("command", cli.COMMANDS)
def test_help_pages_have_words_for_placeholders_and_defaults(command, capsys):
    page = help_page(capsys, command, "--help")
    assert "STR" not in page + help_page(capsys, command, "--help-all")
    assert "(default: )" not in page
    assert "None" not in page
    assert "`" not in page
    assert len(options_of(page)) <= 16


def default_of(option: str, page: str) -> str:
    """The default that a help page states for an option, the words joined over its lines."""
    text = " ".join(page.replace("│", " ").split())
    return text.partition(f" {option} ")[2].partition("(default: ")[2].partition(")")[0]


def test_an_option_with_a_placeholder_of_its_own_has_its_default_in_words(capsys):
    page = help_page(capsys, "encoders", "--help")
    assert "--capture CAPTURE" in page
    assert default_of("--capture", page) == "100 photos of 1440x1080"
    assert default_of("--index", help_page(capsys, "library", "--help")) == "compare with all scenes"


@pytest.mark.parametrize("command", ["build", "compare", "ablate"])
def test_a_setting_of_a_part_has_its_default_in_words(command, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")  # one column
    page = help_page(capsys, command, "--help-all")
    assert default_of("--averaged.dino", page) == "by the tokens of CLIP"


def test_the_help_page_of_build_states_which_methods_use_dino(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    page = " ".join(help_page(capsys, "build", "--help").replace("│", " ").split())
    assert 'Method "trained" uses it, and "averaged" where CLIP is read at class tokens alone' in page


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "rare"),
    [
        ("ablate", {"--forms", "--wrong-labels", "--prompt-list", "--as-in-paper"}),
        ("compare", {"--protocols", "--prompt-list", "--no-lpips"}),
        ("language", {"--progress", "--test-views", "--test-every"}),
        ("edit", {"--grow", "--shrink", "--no-fill", "--strength", "--clip"}),
    ],
)
def test_rare_options_are_on_the_whole_page_only(command, rare, capsys):
    short = help_page(capsys, command, "--help")
    assert f"lexsplat {command} --help-all" in short
    assert not rare & options_of(short)
    assert rare <= options_of(help_page(capsys, command, "--help-all"))


@pytest.mark.slow
@pytest.mark.parametrize("command", ["build", "reconstruct", "language", "compare", "ablate"])
def test_help_shows_what_people_use_and_help_all_the_rest(command, capsys):
    short = help_page(capsys, command, "--help")
    assert {"--output", "--device", "--iterations", "--downscale", "--seed", "--memory"} <= options_of(short)
    assert f"lexsplat {command} --help-all" in short
    whole = options_of(help_page(capsys, command, "--help-all"))
    assert options_of(short) < whole
    assert "--reconstruction.max-gaussians" in whole - options_of(short)
    assert ("--codebook.num-codes" in whole) == (command != "reconstruct")
    assert ("--clip" in whole) == (command != "reconstruct")


def test_the_help_page_of_language_has_the_options_that_its_warnings_name(capsys):
    options = options_of(help_page(capsys, "language", "--help"))
    assert {"--up", "--keep-floaters", "--views-from"} <= options
