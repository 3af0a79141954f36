"""What every test may rely on: no test touches the user's log, and kernels are compiled into the user's cache."""

from __future__ import annotations

from pathlib import Path

import pytest

from trainer.cli.main import keep_kernels

keep_kernels()


@pytest.fixture(autouse=True)
def own_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A log of its own for each test that names none."""
    path = tmp_path / "own.db"
    monkeypatch.setenv("TRAINER_DB", str(path))
    return path
