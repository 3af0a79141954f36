"""What every test may rely on: no test touches the user's log, kernels are compiled into the user's cache, and examples
are the same in every run.
"""

from __future__ import annotations

import importlib
import pkgutil
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

import trainer
from trainer.cli.main import keep_kernels, main

CommandLine = Callable[..., tuple[int, str, str]]

keep_kernels()
# The first example may compile a kernel, and the machines are shared: no example is timed. A change is judged by the
# same examples wherever it is tested; ``pytest -m hypothesis --hypothesis-profile searching`` looks for others.
untimed = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("searching", untimed)
settings.register_profile("steady", untimed, derandomize=True, database=None)
settings.load_profile("steady")


def pytest_collection_finish(session: pytest.Session) -> None:
    """Import the whole program before the first example.

    Hypothesis also draws the numbers that it finds in modules that are imported by then. Those would be others with
    other tests before, as they are where there are more workers, or fewer.
    """
    if not session.testsfailed and any(item.get_closest_marker("hypothesis") for item in session.items):
        for module in pkgutil.walk_packages(trainer.__path__, "trainer."):
            if not module.name.endswith("__main__"):
                importlib.import_module(module.name)


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
