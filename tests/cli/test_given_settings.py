"""Settings that the command line gives beside ``--as-in-paper``: kept or refused, never replaced."""

import pytest

from lexsplat import cli
from lexsplat.cli.arguments import parse
from lexsplat.cli.build import Build

BUILD = ["build", "x", "--output", "y"]


@pytest.mark.parametrize("command", ["build", "reconstruct", "language", "compare", "ablate"])
@pytest.mark.parametrize("given", [["--method", "averaged"], ["--method=averaged"]], ids=" ".join)
def test_a_given_method_that_is_not_the_papers_is_refused_beside_as_in_paper(command, given, capsys):
    with pytest.raises(SystemExit) as caught:
        cli.main([command, "x", "--output", "y", "--as-in-paper", *given])
    assert caught.value.code == 2
    assert capsys.readouterr().err == (
        "error: --method: expected trained, for which --as-in-paper stands, found averaged; "
        "leave --method or --as-in-paper out\n"
    )


@pytest.mark.parametrize(
    ("given", "expected", "found"),
    [
        (["--no-joint"], "True", "False"),
        (["--features.mode", "grid"], "random", "grid"),
        (["--codebook.num_codes", "255"], "128", "255"),
        (["--reconstruction.antialiased"], "False", "True"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else value,
)
def test_a_setting_given_at_its_default_is_refused_where_the_paper_has_another(
    given, expected, found, capsys
):
    with pytest.raises(SystemExit):
        cli.main([*BUILD, *given, "--as-in-paper"])
    line = f"{given[0]}: expected {expected}, for which --as-in-paper stands, found {found}; leave"
    assert line in capsys.readouterr().err


@pytest.mark.parametrize(
    "given",
    [
        ["--method", "trained"],
        ["--joint", "--method", "trained"],
        ["--codebook.num-codes", "64", "--iterations", "3000"],
        ["--reconstruction.no-antialiased", "--dino", "none"],
        ["--memory", "4GB", "--test-every", "8"],
        [],
    ],
    ids=" ".join,
)
def test_settings_that_agree_with_the_paper_or_replace_a_default_are_taken(given):
    assert parse(Build, "build", [*BUILD[1:], "--as-in-paper", *given]).settings.as_in_paper


def test_a_method_is_taken_without_as_in_paper():
    assert parse(Build, "build", [*BUILD[1:], "--method", "averaged"]).settings.method == "averaged"
