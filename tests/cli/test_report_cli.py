"""``trainer report`` and ``trainer export`` over a real log."""

from __future__ import annotations

import errno
import json
from contextlib import closing
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.metrics.synthetic_session import performed, task_of
from trainer.cli import export, report
from trainer.exports.csv_files import FILES
from trainer.exports.files import ExportError
from trainer.geometry import Array
from trainer.log.record import SessionRecord
from trainer.log.schema import LogError
from trainer.metrics import score
from trainer.poses import ToolPoses
from trainer.sinks.log import LogSink
from trainer.sinks.surface import TickRecord

RUNNER = CliRunner()
FULL = Path("/dev/full")


def no_snapshot() -> Array:
    raise AssertionError("the log draws nothing")


def store(path: Path, made: SessionRecord) -> None:
    """Write a record as a session would have."""
    with closing(LogSink(path, made.header)) as sink:
        for i in range(len(made.position)):
            poses = ToolPoses(made.position[i], made.quaternion[i], made.closure[i], made.valid[i])
            events = tuple(e for e in made.events if e.tick == i)
            sink.tick(TickRecord(i, i / made.header.tick_hz, poses, events, no_snapshot))
        metrics = score(made, task_of())
        sink.finish(made.outcome, "", made.ticks, made.duration_s, None, None, metrics)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two sessions of Ada's and one of Ben's."""
    path = tmp_path_factory.mktemp("log") / "log.db"
    for i, who in enumerate(("Ada", "Ada", "Ben")):
        store(path, performed(i, 0.5, session=f"20261120-09000{i}", trainee=who,
                              started_at=f"2026-11-20T09:00:0{i}+00:00"))  # fmt: skip
    return path


def test_a_session_as_json_holds_the_scores_of_its_record(log: Path) -> None:
    result = RUNNER.invoke(report.app, ["session", "20261120-090001", "--db", str(log), "--json"])
    assert result.exit_code == 0
    found = json.loads(result.stdout)
    values = {r["name"]: r["value"] for r in (*found["targets"], *found["others"])}
    assert values == {m.name: m.value for m in score(performed(1, 0.5), task_of())}


def test_a_page_is_written_and_stdout_stays_clean(log: Path, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    result = RUNNER.invoke(report.app, ["session", "last", "--db", str(log), "--html", str(page)])
    assert result.exit_code == 0
    assert result.stdout == ""
    assert str(page) in result.stderr.replace("\n", "")
    assert page.read_text(encoding="utf-8").startswith("<!doctype html>")


@pytest.mark.skipif(not FULL.exists(), reason="no disk that is always full")
def test_a_full_disk_is_told_with_the_name_of_the_file(log: Path) -> None:
    result = RUNNER.invoke(report.app, ["session", "last", "--db", str(log), "--html", str(FULL)])
    assert isinstance(result.exception, OSError)
    assert (result.exception.errno, result.exception.filename) == (errno.ENOSPC, str(FULL))


def test_a_page_that_cannot_be_written_leaves_the_one_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A disk that fills up half-way: neither an empty page nor a part of one, and the error names the page."""

    def half(path: Path, text: str, encoding: str) -> int:
        with path.open("w", encoding=encoding) as file:
            file.write(text[: len(text) // 2])
        raise OSError(errno.ENOSPC, "No space left on device")

    page = tmp_path / "page.html"
    report.write_page(page, "before")
    monkeypatch.setattr(Path, "write_text", half)
    with pytest.raises(OSError, match="No space left") as failed:
        report.write_page(page, "after")
    assert failed.value.filename == str(page)
    assert {p.name: p.read_text() for p in tmp_path.iterdir()} == {"page.html": "before"}


def test_progress_is_that_of_one_trainee(log: Path, tmp_path: Path) -> None:
    page = tmp_path / "progress.html"
    arguments = ["progress", "--trainee", "Ada", "--db", str(log), "--json", "--html", str(page)]
    result = RUNNER.invoke(report.app, arguments)
    found = json.loads(result.stdout)
    assert found["trainee"] == "Ada"
    assert [a["session"] for a in found["tasks"][0]["attempts"]] == ["20261120-090000", "20261120-090001"]
    assert "Progress of Ada" in page.read_text(encoding="utf-8")


def test_reports_are_readable_on_a_terminal(log: Path) -> None:
    assert "targets met" in RUNNER.invoke(report.app, ["session", "last", "--db", str(log)]).stdout
    assert "2 attempts" in RUNNER.invoke(report.app, ["progress", "--trainee", "Ada", "--db", str(log)]).stdout


def test_an_unknown_trainee_is_told_who_is_known(log: Path) -> None:
    result = RUNNER.invoke(report.app, ["progress", "--trainee", "Eve", "--db", str(log)])
    assert isinstance(result.exception, LogError)
    assert "known: Ada, Ben" in str(result.exception)


def test_csv_of_one_trainee(log: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    arguments = ["csv", "--out", str(out), "--trainee", "Ben", "--db", str(log), "--json"]
    result = RUNNER.invoke(export.app, arguments)
    assert result.exit_code == 0
    assert json.loads(result.stdout)["rows"]["sessions.csv"] == 1
    assert {p.name for p in out.iterdir()} == set(FILES)
    again = RUNNER.invoke(export.app, arguments)
    assert isinstance(again.exception, ExportError)
