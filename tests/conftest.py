"""What every test may rely on: no test touches the user's log, and kernels are compiled into the user's cache."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import settings

from trainer.cli.main import keep_kernels, main

CommandLine = Callable[..., tuple[int, str, str]]

keep_kernels()
# The first example may compile a kernel, and the machines are shared: no example is timed.
settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")


@pytest.fixture(autouse=True)
def own_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A log of its own for each test that names none."""
    path = tmp_path / "own.db"
    monkeypatch.setenv("TRAINER_DB", str(path))
    return path


@pytest.fixture
def command_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> CommandLine:
    """Runs ``trainer …`` in this process as the shell would: exit code, stdout, stderr."""

    def run(*arguments: str | Path) -> tuple[int, str, str]:
        monkeypatch.setattr("sys.argv", ["trainer", *map(str, arguments)])
        code = 0
        try:
            main()
        except SystemExit as end:
            if isinstance(end.code, str):
                print(end.code, file=sys.stderr)
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
        out, err = capsys.readouterr()
        # Whoever comes first on a machine is told to wait; which test that is, is chance.
        lines = [line for line in err.splitlines(keepends=True) if not line.startswith("compiling kernels once")]
        return code, out, "".join(lines)

    return run
