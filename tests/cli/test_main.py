"""The command line as a whole: its commands, its errors, and that the README tells the truth about it."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import typer.main

from trainer import __version__
from trainer.cli import main as command_line_module
from trainer.cli.main import build_app
from trainer.config import ConfigError
from trainer.log.schema import LogError
from trainer.sinks.rrd_file import RecordingError

CommandLine = Callable[..., tuple[int, str, str]]
ROOT = Path(__file__).parent.parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")


def commands(group: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Every command that does something, with the words that call it."""
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from commands(command, (*path, name))
        else:
            yield (*path, name), command


COMMANDS = dict(commands(typer.main.get_command(build_app())))


def test_the_version_is_told(command_line: CommandLine) -> None:
    assert command_line("--version") == (0, f"trainer {__version__}\n", "")


def test_help_names_every_command(command_line: CommandLine) -> None:
    code, out, err = command_line("--help")
    assert (code, err) == (0, "")
    assert {path[0] for path in COMMANDS} <= set(out.split())


@pytest.mark.parametrize("path", COMMANDS, ids=" ".join)
def test_every_command_has_help_and_is_in_the_readme(path: tuple[str, ...], command_line: CommandLine) -> None:
    assert command_line(*path, "--help")[0] == 0
    assert COMMANDS[path].help
    for parameter in COMMANDS[path].params:
        assert parameter.name == "help" or parameter.help, f"{parameter.name} has no help"
    assert re.search(rf"\btrainer {' '.join(path)}\b", README)


QUESTIONS = [
    path for path in COMMANDS if path[-1] in {"list", "show", "check", "score", "session", "progress", "practice"}
]


@pytest.mark.parametrize("path", QUESTIONS, ids=" ".join)
def test_every_command_that_answers_can_answer_in_json(path: tuple[str, ...]) -> None:
    assert "--json" in {option for parameter in COMMANDS[path].params for option in parameter.opts}


@pytest.mark.parametrize("arguments", [["practise"], ["curricula", "lst"], ["curricula", "show"], ["--nothing"]])
def test_wrong_usage_exits_with_2(arguments: list[str], command_line: CommandLine) -> None:
    code, out, err = command_line(*arguments)
    assert (code, out) == (2, "")
    assert "Usage: trainer" in err


ERRORS = [
    (ConfigError("f.toml: 'wall_mm' must be > 0, found 0"), "trainer: f.toml: 'wall_mm' must be > 0, found 0\n"),
    (LogError("log.db: the disk is full"), "trainer: log.db: the disk is full\n"),
    (
        RecordingError(Path("x.rrd"), OSError(28, "No space left on device")),
        "trainer: x.rrd: cannot write the recording: No space left on device\n",
    ),
    (PermissionError(13, "Permission denied", "/locked/x"), "trainer: /locked/x: Permission denied\n"),
    (OSError(28, "No space left on device"), "trainer: No space left on device\n"),
]


def raising(error: BaseException, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(path: Path, check_task: object) -> list[str]:
        raise error

    monkeypatch.setattr("trainer.curriculum.check", fail)


@pytest.mark.parametrize(("error", "line"), ERRORS, ids=[line for _, line in ERRORS])
def test_an_error_is_one_line_and_exit_code_1(
    error: BaseException, line: str, command_line: CommandLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    raising(error, monkeypatch)
    assert command_line("curricula", "check", "x") == (1, "", line)


def test_ctrl_c_is_one_line_and_the_shells_exit_code(
    command_line: CommandLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    raising(KeyboardInterrupt(), monkeypatch)
    assert command_line("curricula", "check", "x") == (130, "", "trainer: interrupted\n")


def test_a_fault_of_the_program_is_not_hidden(command_line: CommandLine, monkeypatch: pytest.MonkeyPatch) -> None:
    """What nobody foresaw keeps its traceback: it is for a developer."""
    raising(ZeroDivisionError("division by zero"), monkeypatch)
    with pytest.raises(ZeroDivisionError):
        command_line("curricula", "check", "x")


def test_a_developer_sees_every_traceback(command_line: CommandLine, monkeypatch: pytest.MonkeyPatch) -> None:
    raising(ConfigError("x"), monkeypatch)
    monkeypatch.setenv("TRAINER_DEBUG", "1")
    with pytest.raises(ConfigError):
        command_line("curricula", "check", "x")


@pytest.mark.parametrize("arguments", [["--version"], ["--help"], ["curricula", "show", "anastomosis/single-stitch"]])
def test_a_reader_that_leaves_is_no_error(arguments: list[str]) -> None:
    """Like `trainer … | head -0`, for output that fits the buffer and output that does not: exit code 1, no word."""
    read, write = os.pipe()
    os.close(read)
    command = [sys.executable, "-m", "trainer", *arguments]
    buffered = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    done = subprocess.run(command, cwd=ROOT, env=buffered, stdout=write, stderr=subprocess.PIPE, text=True, check=False)
    os.close(write)
    assert (done.returncode, done.stderr) == (1, "")


def test_kernels_are_kept_where_the_user_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/somewhere")
    command_line_module.keep_kernels()
    assert os.environ["NUMBA_CACHE_DIR"] == "/somewhere"
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    command_line_module.keep_kernels()
    assert Path(os.environ["NUMBA_CACHE_DIR"]).name == "kernels"


def test_kernels_are_kept_in_a_private_folder_where_there_is_no_home(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A home that is a file cannot hold a cache, for root neither. A folder that others can write to is not used."""
    (tmp_path / "home").touch()
    (tmp_path / "tmp").mkdir()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home" / "cache"))
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "tmp"))
    expected = tmp_path / "tmp" / f"trainer-kernels-{os.getuid()}"
    kept = []
    for mode in (0o700, 0o700, 0o777):
        monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
        if expected.exists():
            expected.chmod(mode)
        command_line_module.keep_kernels()
        kept.append(Path(os.environ["NUMBA_CACHE_DIR"]))
    assert kept[0] == kept[1] == expected
    assert kept[2] != expected
    assert kept[2].parent == tmp_path / "tmp"
    assert kept[2].stat().st_mode & 0o777 == 0o700


@pytest.mark.parametrize("arguments", [["--version"], ["--help"], ["curricula", "list"]])
def test_output_that_nobody_wants_is_no_error(arguments: list[str]) -> None:
    """``>&-``: there is no stdout from the start."""
    command = ["sh", "-c", 'exec "$@" >&-', "sh", sys.executable, "-m", "trainer", *arguments]
    done = subprocess.run(command, cwd=ROOT, stderr=subprocess.PIPE, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def shown_commands() -> list[list[str]]:
    """Every ``trainer …`` in the code blocks of the README, as words."""
    blocks = re.findall(r"^```\w*\n(.*?)^```", README, flags=re.MULTILINE | re.DOTALL)
    lines = [line.split("#")[0].strip() for block in blocks for line in block.splitlines()]
    found = [shlex.split(line) for line in lines]
    return [words[1:] for words in found if words and words[0].rpartition("/")[2] == "trainer"]


@pytest.mark.parametrize("words", shown_commands(), ids=" ".join)
def test_a_command_in_the_readme_exists_with_its_options(words: list[str]) -> None:
    if words == ["--version"]:
        return
    path = next(path for path in COMMANDS if tuple(words[: len(path)]) == path)
    known = {o for parameter in COMMANDS[path].params for o in (*parameter.opts, *parameter.secondary_opts)}
    assert {word for word in words if word.startswith("--")} <= known | {"--help"}


def test_the_readme_shows_commands() -> None:
    assert len(shown_commands()) > 10


def test_a_make_target_in_the_readme_exists() -> None:
    targets = re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), flags=re.MULTILINE)
    named = re.findall(r"\bmake ([a-z]+)\b", README)
    assert {"demo", "test"} <= set(named) <= set(targets)
