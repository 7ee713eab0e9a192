"""Wrong usage, Ctrl-C and closed pipes of the command line."""

import contextlib
import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest
import tyro
from support.forked_commands import Command

from lexsplat import cli
from lexsplat.cli.arguments import parse
from lexsplat.cli.build import Build, Reconstruct
from lexsplat.cli.captures import capture_and_settings
from lexsplat.cli.edit import Edit
from lexsplat.cli.listing import List
from lexsplat.cli.query import Query
from lexsplat.cli.values import parse_length
from lexsplat.pipeline.config import BuildConfig


@pytest.mark.parametrize(
    "arguments",
    [
        ["build"],
        ["build", "x", "--output", "y", "--memory", "plenty"],
        ["build", "x", "--output", "y", "--downscale", "-1"],
        ["build", "x", "--output", "y", "--iterations", "0"],
        ["build", "x", "--output", "y", "--reconstruction.iterations", "5"],
        ["build", "x", "--output", "y", "--features.memory", "5"],
        ["build", "x", "--output", "y", "--test-every", "1"],
        ["build", "x", "--output", "y", "--codebook.num-codes", "300"],
        ["query", "x", "apple", "--threshold", "nan"],
        ["query", "x", "apple", "--template", "no braces"],
        ["query", "x", "apple", "--temperature", "-1"],
        ["query", "x", "apple", "--negatives", "thing", " "],
        ["build", "x", "--output", "y", "--seed", "-1"],
        ["build", "x", "--output", "y", "--seed", str(2**70)],
        ["build", "x", "--output", "y", "--reconstruction.max-gaussians", "0"],
        ["language", "x", "--output", "y", "--splats", "z.ply", "--joint", "--method", "trained"],
        ["language", "--output", "y"],
        ["embed", "--splats", "z.ply", "--output", "y", "--test-views", "a"],
        ["poses", "x", "--output", "y", "--memory", "plenty"],
        ["poses", "x", "--output", "y", "--seed", "-1"],
        ["demo", "--iterations", "0"],
        ["demo", "--seed", "-1"],
        ["compare", "x", "--output", "y", "--seeds", "-1"],
        ["compare", "x", "--output", "y", "--clip", "c", "--features-from", "f"],
        ["publish", "x", "y", "--max-splats", "1"],
        ["edit", "x", "delete", "--select", "a", "--threshold", "nan"],
        ["edit", "x", "delete", "--select", "a", "--grow", "-1"],
        ["edit", "x", "delete", "--select", "a", "--shrink", "inf"],
        ["edit", "x", "move", "--select", "a", "--by", "nan", "0", "0"],
        ["edit", "x", "move", "--select", "a", "--turn", "inf"],
        ["edit", "x", "move", "--select", "a", "--scale", "0"],
        ["edit", "x", "recolor", "--select", "a", "--color", "255", "0", "0"],
        ["edit", "x", "recolor", "--select", "a", "--color", "1", "0", "0", "--strength", "2"],
        ["export", "x", "a.ply", "--select", "a", "--threshold", "nan"],
        ["edit", "x", "recolor", "--select", "a", "--color", "#ff88"],
        ["edit", "x", "recolor", "--select", "a", "--color", "reddish"],
        ["scale", "x", "--up", "0,0,0"],
        ["scale", "x", "--distance", "9.5qm", "--height-of", "a"],
        ["scale", "x", "--distance", "-1cm", "--height-of", "a"],
        ["query", "x"],
        ["find", "x"],
    ],
    ids=" ".join,
)
def test_wrong_usage_has_status_2_and_no_traceback(arguments, capsys):
    with pytest.raises(SystemExit) as caught:
        cli.main(arguments)
    assert caught.value.code == 2
    assert "Traceback" not in capsys.readouterr().err


def test_features_of_another_program_name_the_methods_of_compare_that_cannot_use_them(capsys):
    arguments = ["compare", "x", "--output", "y", "--clip", "c", "--features-from", "f"]
    with pytest.raises(SystemExit):
        cli.main([*arguments, "--methods", "averaged", "lerf", "3dovs", "dff"])
    told = " ".join(capsys.readouterr().err.replace("│", "").split())
    assert "lerf and 3dovs need several crop sizes: give --methods averaged dff" in told


@pytest.mark.parametrize(
    ("command", "arguments"),
    [
        ("build", ["--splats", "g.ply"]),
        ("build", ["g.ply"]),
        ("reconstruct", ["g.ply"]),
        ("language", ["g.ply"]),
    ],
    ids=str,
)
def test_splats_in_place_of_a_capture_are_sent_to_language(command, arguments, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("g.ply").write_bytes(b"ply")
    with pytest.raises(SystemExit) as caught:
        cli.main([command, *arguments, "--output", "scene"])
    assert caught.value.code == 2
    assert "lexsplat language --splats FILE --output SCENE" in capsys.readouterr().err


STOPPED = "stopped; run the same command again to go on\n"


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        RuntimeError("DefaultCPUAllocator: can't allocate memory"),
        RuntimeError("could not create a primitive\n"),
    ],
    ids=repr,
)
def test_a_lack_of_memory_is_named_with_its_remedy(error, monkeypatch, capsys):
    def exhausted(*_, **__):
        raise error

    monkeypatch.setattr(tyro, "cli", exhausted)
    assert cli.main(["info", "demo"]) == 1
    assert capsys.readouterr().err.startswith("error: out of memory; give a smaller --memory")


@pytest.mark.parametrize(
    ("number", "told"),
    [(errno.EACCES, "Permission denied; allow it, or give another place"),
     (errno.ENOSPC, "No space left on device; free some space and run the same command again"),
     (errno.EEXIST, "expected a folder, found a file; give another place"),
     (errno.ENOTDIR, "expected a folder, found a file; give another place"),
     (errno.EISDIR, "expected a file, found a folder; give another name"),
     (errno.ENOENT, "expected a path that exists or can be made, found none; check it, or give another place"),
     (errno.EIO, "Input/output error")],
)  # fmt: skip
def test_an_error_of_the_system_is_one_line_with_its_remedy(number, told, monkeypatch, capsys):
    def fail(self):
        raise OSError(number, os.strerror(number), "place/file.png")

    monkeypatch.setattr("lexsplat.cli.info.Info.run", fail)
    assert cli.main(["info", "demo"]) == 1
    assert capsys.readouterr().err == f"error: place/file.png: {told}\n"


def test_ctrl_c_during_parsing_ends_in_one_line(monkeypatch, capsys):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(tyro, "cli", interrupted)
    assert cli.main(["info", "demo"]) == 130
    assert capsys.readouterr().err == STOPPED


@pytest.mark.slow
def test_ctrl_c_during_imports_ends_in_one_line():
    interrupting = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background is started with it ignored
from lexsplat.__main__ import main
class Interrupting:
    def find_spec(self, name, path=None, target=None):
        if name == "torch":
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Interrupting())
sys.argv = ["lexsplat", "info", "demo"]
sys.exit(main())
"""
    done = subprocess.run(
        [sys.executable, "-c", interrupting], capture_output=True, text=True, timeout=120, check=False
    )
    said = [line for line in done.stderr.splitlines(keepends=True) if not line.startswith("start: ")]
    assert (done.returncode, said) == (130, [STOPPED]), (
        "on a slow machine the progress of the start comes first"
    )


def output_in_a_terminal(*words: str, **environment: str) -> tuple[str, str]:
    """What a command prints on standard output, a terminal, and on standard error, a pipe."""
    pty = pytest.importorskip("pty", reason="Windows has none")
    ours, theirs = pty.openpty()
    done = subprocess.run(
        [sys.executable, "-m", "lexsplat", *words], stdout=theirs, stderr=subprocess.PIPE, text=True, check=False,
        timeout=120, env={**os.environ, "TERM": "xterm", **environment},
    )  # fmt: skip
    os.close(theirs)
    said = b""
    with contextlib.suppress(OSError):  # the end of a closed terminal
        while part := os.read(ours, 4096):
            said += part
    os.close(ours)
    return said.decode(), done.stderr


@pytest.mark.slow
def test_no_color_is_heard_and_what_is_no_terminal_gets_none():
    assert "\x1b[" in output_in_a_terminal("info", "--help", NO_COLOR="")[0]
    page = output_in_a_terminal("info", "--help", NO_COLOR="1")[0]
    assert "--json" in page
    assert "\x1b[" not in page
    refused = output_in_a_terminal("find", "demo", "mug", "--threshold", "x")[1]
    assert "expected a number, found 'x'" in refused
    assert "\x1b[" not in refused


def test_text_that_the_encoding_of_the_output_lacks_is_named_with_its_remedy(monkeypatch, capsys):
    def fail(self):
        "\N{RED APPLE}".encode("latin-1")

    monkeypatch.setattr("lexsplat.cli.info.Info.run", fail)
    assert cli.main(["info", "demo"]) == 1
    told = (
        "\\U0001f34e': expected characters of the encoding latin-1, found others; set PYTHONIOENCODING=utf-8"
    )
    assert capsys.readouterr().err == f"error: {told}\n"


def test_a_command_runs_without_standard_output(monkeypatch):
    monkeypatch.setattr("sys.stdout", None)
    monkeypatch.setattr("lexsplat.cli.waiting.LateProgress.__init__.__defaults__", (0.0,))
    assert cli.main(["info", "demo"]) == 0


def test_version_is_printed(capsys):
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("lexsplat 0.")


def test_the_package_runs_as_a_module_too():
    answer = subprocess.run([sys.executable, "-m", "lexsplat", "--version"], capture_output=True, text=True)
    assert (answer.returncode, answer.stdout.split()[0]) == (0, "lexsplat")


@pytest.mark.parametrize("arguments", [("build", "--help"), ("info", "demo")])
def test_a_closed_pipe_ends_a_command_quietly(arguments):
    with Command(*arguments, heard=False) as command:
        ended = command.ended()
    assert (ended.status, ended.err) == (0, "")


@pytest.mark.slow
def test_a_closed_pipe_ends_a_process_quietly():
    command = [sys.executable, "-m", "lexsplat", "query", "--help"]  # it imports little
    environment = {
        **os.environ,
        "PYTHONUNBUFFERED": "",
    }  # without a buffer, the end has nothing left to write
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, env=environment) as process:
        process.stdout.close()  # as `| head` does, before the first line
        error = process.stderr.read()
    assert "Traceback" not in error
    assert "Broken pipe" not in error
    assert process.returncode == 0


@pytest.mark.slow
def test_a_build_whose_progress_nobody_reads_any_more_is_stopped_and_says_so(tiny_capture, tmp_path):
    words = [
        "build", str(tiny_capture), "--output", str(tmp_path / "scene"),
        "--progress", "json", "--clip", "bundled", "--dino", "none", "--device", "cpu", "--iterations", "6",
        "--downscale", "4",
    ]  # fmt: skip
    with Command(*words) as command:
        assert command.stdout.readline()
        command.stdout.close()  # as `| head -1` does
        status, error = command.wait(), command.errors()
    told = [line for line in error.splitlines() if "error: " in line]
    assert status == 1, error
    assert len(told) == 1, error
    assert (
        "lexsplat build: expected a reader of its output until it ends, found a closed pipe; run" in told[0]
    )
    assert "Traceback" not in error


def run_elsewhere(arguments: list[str]) -> subprocess.CompletedProcess:
    """A command in a process of its own, which prints the loaded modules at its end."""
    code = (
        "import sys\n"
        "from lexsplat.__main__ import main\n"
        f"sys.argv = {['lexsplat', *arguments]!r}\n"
        "try: status = main()\n"
        "except SystemExit as ended: status = ended.code\n"
        "print('LOADED', *(m for m in ('torch', 'numpy', 'tyro') if m in sys.modules))\n"
        "sys.exit(status)"
    )
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)


@pytest.mark.parametrize(
    ("arguments", "status"), [(["--version"], 0), (["--help"], 0), ([], 2), (["querry"], 2), (["--seed"], 2)]
)
def test_what_needs_no_command_loads_no_libraries(arguments, status):
    done = run_elsewhere(arguments)
    assert done.returncode == status
    assert done.stdout.splitlines()[-1] == "LOADED"


def test_a_mistyped_command_gets_a_suggestion(capsys):
    for word, hint in (
        ("querry", "did you mean query?"),
        ("embedd", "did you mean embed?"),
        ("xyz", "--help"),
    ):
        with pytest.raises(SystemExit) as ended:
            cli.main([word])
        assert ended.value.code == 2
        assert hint in capsys.readouterr().err


def test_the_overview_lists_every_command(capsys):
    assert cli.main(["--help"]) == 0
    page = capsys.readouterr().out
    for name, entry in cli.COMMANDS.items():
        assert f"  {name} " in page
        assert entry.summary in page
    assert "lexsplat COMMAND --help-all   all options\n" in page


def test_the_help_page_that_an_error_names_is_that_of_the_command(capsys):
    with pytest.raises(SystemExit):
        cli.main(["query", "x", "apple", "--threshold", "abc"])
    error = " ".join(capsys.readouterr().err.replace("│", " ").split())
    assert "expected a number, found 'abc'" in error
    assert "All options: lexsplat query --help" in error
    assert "--help-all" not in error, "its help page has all options"
    assert "(default: none)" not in error


@pytest.mark.parametrize("columns", ["60", "80", "200"])
@pytest.mark.parametrize(
    "wrong", [["--reconstruction.max-gaussians", "many"], ["--seedd", "3"]], ids=" ".join
)
def test_an_error_names_the_help_page_that_lists_every_option(wrong, columns, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", columns)
    with pytest.raises(SystemExit) as ended:
        cli.main(["build", "x", "--output", "y", *wrong])
    assert ended.value.code == 2
    error = capsys.readouterr().err
    assert "All options: lexsplat build --help-all " in error
    assert "none)" not in error
    assert len(set(map(len, error.splitlines()))) == 1, "the panel keeps its frame"


@pytest.mark.parametrize(
    ("arguments", "told"),
    [(["build"], "of masks/NAME.png are"), (["compare", "x"], "results. ablate with"),
     (["build", "x", "--output", "y", "--codebook.num-codes", "many"], "found 'many'")],
)  # fmt: skip
def test_an_error_has_no_code_marks_and_its_panel_keeps_its_frame(arguments, told, capsys):
    with pytest.raises(SystemExit):
        cli.main(arguments)
    error = capsys.readouterr().err
    assert told in " ".join(error.replace("│", " ").split())
    assert "`" not in error
    assert len(set(map(len, error.splitlines()))) == 1


def test_an_empty_negative_is_named_as_one(capsys):
    with pytest.raises(SystemExit):
        cli.main(["query", "x", "apple", "--negatives", ""])
    assert "negatives: expected words or phrases, found an empty text; name" in capsys.readouterr().err


def test_reconstruct_accepts_the_options_of_build():
    words = ["x", "--output", "y", "--clip", "bundled", "--codebook.num-codes", "16"]
    assert parse(Reconstruct, "reconstruct", words).settings.codebook.num_codes == 16


def test_other_spellings_are_accepted():
    for page in (Query, List):
        assert parse(page, "page", ["x", *(["cup"] if page is Query else []), "--pictures"]).images
    assert not parse(Query, "query", ["x", "cup", "--no-pictures"]).images
    words = ["x", "recolour", "--select", "a", "--colour", "#ff8000"]
    edit = parse(Edit, "edit", words)
    assert edit.action == "recolor"
    assert edit.color == pytest.approx((1, 128 / 255, 0))
    assert parse(Edit, "edit", [*words[:-1], "orange"]).color == pytest.approx((1, 165 / 255, 0))
    assert parse(Edit, "edit", [*words[:-1], "1", "0.5", "0"]).color == (1, 0.5, 0)


def test_settings_keep_their_spellings_of_the_first_scene_folders():
    words = [
        "x",
        "--output",
        "y",
        "--averaging.top=3",
        "--embedding.iterations",
        "40",
        "--embedding.lambda_u",
        "2",
    ]
    settings = parse(Build, "build", [*words, "--embedding.no-normalise-rendering"]).settings
    assert settings.averaged.top == 3
    assert (settings.trained.iterations, settings.trained.lambda_u) == (40, 2)
    assert not settings.trained.normalize_rendering


@pytest.mark.parametrize(
    ("text", "meters"),
    [("9.5cm", 0.095), ("0.095", 0.095), ("95 mm", 0.095), ("2ft", 0.6096), ("1e-1m", 0.1)],
)
def test_lengths_have_units(text, meters):
    assert parse_length(text) == pytest.approx(meters)


def test_a_folder_that_hides_a_bundled_scene_is_noted(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["info", "demo"]) == 0
    assert capsys.readouterr().err == ""
    (tmp_path / "demo").mkdir()
    assert cli.main(["info", "demo"]) == 0, "an empty folder hides no scene"
    assert capsys.readouterr().err == ""
    (tmp_path / "demo" / "scene.json").write_text("{}")
    assert cli.main(["info", "demo"]) == 1
    assert (
        capsys.readouterr()
        .err.splitlines()[0]
        .startswith("note: demo is the folder in the working directory")
    )
    assert capture_and_settings("demo", BuildConfig()) == (Path("demo"), BuildConfig())
    assert "note: demo" in capsys.readouterr().err


@pytest.mark.parametrize(("word", "folder"), [("demo", "tabletop"), ("second", "second")])
def test_build_takes_the_words_of_bundled_captures(word, folder, tmp_path, monkeypatch):
    from lexsplat.pipeline import build as module

    received = []
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(module, "build", lambda *arguments, **_: received.extend(arguments) or stop())

    def stop():
        raise KeyboardInterrupt

    assert cli.main(["build", word, "--output", "scene"]) == 130
    capture, output, settings = received
    assert (capture.name, output) == (folder, Path("scene"))
    assert (settings.clip, settings.dino) == ("bundled", "bundled")
