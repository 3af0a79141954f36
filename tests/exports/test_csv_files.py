"""The CSV export reads back exactly, says its units, and overwrites nothing."""

from __future__ import annotations

import csv
import json
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.metrics.synthetic_session import DRIVE, performed, record, task_of
from trainer.events import from_row
from trainer.exports.csv_files import FILES, write
from trainer.exports.files import ExportError
from trainer.metrics import score


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_everything_reads_back_exactly(tmp_path: Path) -> None:
    """Numbers are written with as many digits as they need: not a bit is lost."""
    made = performed(seed=5, trainee='Åsa, "the quick"\nLind', session="S-1")
    counts = write([made], tmp_path / "out")
    out = tmp_path / "out"
    assert {p.name for p in out.iterdir()} == set(FILES) == set(counts)
    session = rows(out / "sessions.csv")[0]
    assert session["trainee"] == 'Åsa, "the quick"\nLind'
    assert float(session["duration_s"]) == made.duration_s
    events = tuple(
        from_row(int(r["tick"]), int(r["seq"]), float(r["time_s"]), r["tool"], r["kind"], r["data_json"])
        for r in rows(out / "events.csv")
    )
    assert events == made.events
    for r, m in zip(rows(out / "metrics.csv"), score(made, task_of()), strict=True):
        assert (r["metric"], r["unit"], r["version"]) == (m.name, m.unit, m.version)
        assert (float(r["value"]) if r["value"] else None) == m.value
    poses = rows(out / "poses.csv")
    assert len(poses) == counts["poses.csv"] == 2 * len(made.position)
    read = np.array([[float(r[c]) for c in ("x_mm", "y_mm", "z_mm")] for r in poses]).reshape(-1, 2, 3)
    np.testing.assert_array_equal(read, made.position)
    assert [r["tool"] for r in poses[:2]] == ["left", "right"]
    assert float(poses[2]["time_s"]) == 0.01


@pytest.mark.parametrize("name", ["=cmd|' /C calc'!A0", "+1", "-Ana", "@Ana"])
def test_no_name_is_a_formula(name: str, tmp_path: Path) -> None:
    """Numbers stay numbers, negative ones too: reading back exactly is tested above."""
    write([performed(seed=5, trainee=name)], tmp_path / "out")
    assert rows(tmp_path / "out" / "sessions.csv")[0]["trainee"] == f"'{name}"


def test_unseen_tools_are_marked(tmp_path: Path) -> None:
    valid = np.array([[True, False], [True, True]])
    write([record(valid=valid)], tmp_path / "out")
    assert [r["valid"] for r in rows(tmp_path / "out" / "poses.csv")] == ["1", "0", "1", "1"]


def test_sessions_of_different_tasks_share_the_files(tmp_path: Path) -> None:
    counts = write([record(session="a"), record(session="b", reference=DRIVE)], tmp_path / "out")
    assert counts["sessions.csv"] == 2
    assert {r["session"] for r in rows(tmp_path / "out" / "metrics.csv")} == {"a", "b"}


def test_columns_with_a_unit_say_it() -> None:
    columns = [c for names, _ in FILES.values() for c in names]
    plain = {
        "session", "trainee", "task", "task_sha256", "anatomy", "anatomy_sha256", "device", "seed", "started_at",
        "status", "outcome", "ticks", "trainer_version", "tick", "seq", "tool", "kind", "data_json", "metric", "value",
        "unit", "target_low", "target_high", "source", "version", "qw", "qx", "qy", "qz", "closure", "valid",
    }  # fmt: skip
    for column in set(columns) - plain:
        assert column.rpartition("_")[2] in {"s", "mm", "hz"}, column


def test_payloads_are_json(tmp_path: Path) -> None:
    write([performed()], tmp_path / "out")
    assert all(isinstance(json.loads(r["data_json"]), dict) for r in rows(tmp_path / "out" / "events.csv"))


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ExportError, match="is not empty; nothing is overwritten, name a new folder with --out"):
        write([record()], tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]
    with pytest.raises(ExportError, match="is a file"):
        write([record()], tmp_path / "notes.txt")


@contextmanager
def little_room(size: int) -> Iterator[None]:
    """Files of this process cannot grow beyond ``size`` bytes, as on a disk that is full."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("size", [600, 20_000])
def test_where_a_file_finds_no_room_it_is_named_and_nothing_half_written_stays(size: int, tmp_path: Path) -> None:
    """Whether the rows do not fit or, of few, what is left of them when the file is closed: 8 kB wait until then."""
    with little_room(size), pytest.raises(OSError, match="File too large") as caught:
        write([performed(i, 0.5) for i in range(2)], tmp_path / "out")
    assert Path(caught.value.filename).parent == tmp_path / "out"
    assert list((tmp_path / "out").iterdir()) == []


def test_an_empty_folder_may_be_filled(tmp_path: Path) -> None:
    assert write([record()], tmp_path)["sessions.csv"] == 1


def test_sessions_tell_their_knee(tmp_path: Path) -> None:
    """Its name, and which it is, wherever it lies; both are empty where a task has none."""
    made = record(session="b")
    versions = {"anatomy": "/data/my-knee", "anatomy_sha256": "ab" * 32}
    write([record(), replace(made, header=replace(made.header, versions=versions))], tmp_path / "out")
    found = [(r["anatomy"], r["anatomy_sha256"]) for r in rows(tmp_path / "out" / "sessions.csv")]
    assert found == [("", ""), ("my-knee", "ab" * 32)]
