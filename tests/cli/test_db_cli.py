"""``trainer db`` answers with the right exit code and never destroys a file."""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.log.log_samples import execute, header, pierce, step, write
from trainer.cli.db import app
from trainer.log import reader, seal
from trainer.log.schema import LogError, open_log
from trainer.sinks.log import LogSink

FIRST, SECOND = "20261122-013145-7f3a", "20261122-020000-0001"
runner = CliRunner()


@pytest.fixture
def path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "s.db"
    write(path, FIRST)
    write(path, SECOND)
    monkeypatch.setenv("TRAINER_DB", str(path))
    return path


def test_check_of_an_untouched_log(path: Path) -> None:
    got = runner.invoke(app, ["check"])
    assert (got.exit_code, got.stdout) == (0, f"{path}: 2 sessions, each as it was sealed\n")


def test_check_names_a_changed_session(path: Path) -> None:
    execute(path, "update events set time_s = time_s + 1e-9 where session = ? and tick = 3", (SECOND,))
    problem = f"session {SECOND}: its rows are not those that were sealed"
    got = runner.invoke(app, ["check", "--db", str(path)])
    assert (got.exit_code, got.stdout, got.stderr) == (1, "", f"{problem}\n")
    got = runner.invoke(app, ["check", "--json"])
    assert (got.exit_code, got.stderr) == (1, "")
    assert json.loads(got.stdout) == {"db": str(path), "sessions": 2, "problems": [problem]}


def test_backup_is_a_log_with_the_same_sessions(path: Path, tmp_path: Path) -> None:
    got = runner.invoke(app, ["backup", str(tmp_path / "copy.db")])
    assert got.exit_code == 0
    with open_log(path) as db, open_log(tmp_path / "copy.db") as copy:
        assert reader.list_sessions(copy) == reader.list_sessions(db)
        assert seal.check(copy) == []


def test_backup_while_a_session_is_being_written(path: Path, tmp_path: Path) -> None:
    with closing(LogSink(path, header("20261122-030000-0002"))) as sink:
        for tick in range(30):
            sink.tick(step(tick, pierce(tick)))
        assert runner.invoke(app, ["backup", str(tmp_path / "copy.db")]).exit_code == 0
    with open_log(tmp_path / "copy.db") as copy:
        assert [s.status for s in reader.list_sessions(copy)] == ["ended", "ended", "running"]
        assert seal.check(copy) == []


def test_backup_overwrites_nothing(path: Path, tmp_path: Path) -> None:
    (tmp_path / "copy.db").write_text("precious")
    got = runner.invoke(app, ["backup", str(tmp_path / "copy.db")])
    assert isinstance(got.exception, LogError)
    assert str(got.exception) == f"{tmp_path / 'copy.db'}: exists already; name a new file"
    assert (tmp_path / "copy.db").read_text() == "precious"


def test_backup_into_nowhere_leaves_nothing(path: Path, tmp_path: Path) -> None:
    got = runner.invoke(app, ["backup", str(tmp_path / "no" / "copy.db")])
    assert isinstance(got.exception, LogError)
    assert str(got.exception) == f"{tmp_path / 'no' / 'copy.db'}: No such file or directory"


def test_migrate_an_up_to_date_log(path: Path) -> None:
    got = runner.invoke(app, ["migrate"])
    assert (got.exit_code, got.stdout) == (0, f"{path}: up to date already\n")


@pytest.mark.parametrize("command", [["check"], ["migrate"], ["backup", "copy.db"]])
def test_no_log_is_said_so(command: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    got = runner.invoke(app, [*command, "--db", "none.db"])
    assert isinstance(got.exception, LogError)
    assert "none.db: no log here" in str(got.exception)
    assert list(tmp_path.iterdir()) == []
