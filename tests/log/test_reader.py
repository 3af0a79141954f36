"""What is read is what was written."""

from __future__ import annotations

import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.log.log_samples import METRICS, execute, header, pierce, poses, task_done, write
from trainer.events import payload
from trainer.log import reader
from trainer.log.schema import LogError, create_log, open_log

FIRST, SECOND = "20261122-013145-7f3a", "20261122-020000-0001"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "s.db"
    write(path, FIRST)
    write(path, SECOND, ticks=3, trainee="Bo", recording="b.rrd")
    return path


def test_header_round_trip(path: Path) -> None:
    with open_log(path) as db:
        assert reader.header(db, FIRST) == header(FIRST)
        assert reader.header(db, SECOND) == header(SECOND, trainee="Bo", recording="b.rrd")


def test_events_and_poses_come_back_bit_for_bit(path: Path) -> None:
    with open_log(path) as db:
        record = reader.load(db, FIRST)
    written = [*(pierce(t) for t in range(0, 12, 3)), task_done(11, 5)]
    assert [(type(e), e.time_s, e.tick, e.seq, e.tool, payload(e)) for e in record.events] == [
        (type(e), e.time_s, e.tick, e.seq, e.tool, payload(e)) for e in written
    ]  # by the text of the payload, because -0.0 == 0.0
    assert record.first_tick == 0
    for tick in range(12):
        p = poses(tick)
        np.testing.assert_array_equal(record.position[tick], p.position)
        np.testing.assert_array_equal(record.quaternion[tick], p.quaternion)
        np.testing.assert_array_equal(record.closure[tick], p.closure)
        np.testing.assert_array_equal(record.valid[tick], p.valid)
    assert record.position.shape == (12, 2, 3)
    assert (record.status, record.outcome, record.ticks, record.duration_s) == ("ended", "completed", 12, 0.12)


def test_metrics_round_trip_in_their_order(path: Path) -> None:
    with open_log(path) as db:
        assert reader.stored_metrics(db, FIRST) == METRICS


def test_sessions_are_listed_by_time_and_trainee(path: Path) -> None:
    with open_log(path) as db:
        assert [s.id for s in reader.list_sessions(db)] == [FIRST, SECOND]
        (bo,) = reader.list_sessions(db, "Bo")
        assert (bo.id, bo.trainee, bo.outcome, bo.recording, bo.realtime) == (
            SECOND,
            "Bo",
            "completed",
            "b.rrd",
            {"overruns": 0},
        )
        with pytest.raises(LogError, match="'Cy'; known: Ana, Bo"):
            reader.list_sessions(db, "Cy")


def test_a_session_is_found_by_the_beginning_of_its_id(path: Path) -> None:
    with open_log(path) as db:
        assert reader.resolve(db, "20261122-01") == FIRST
        assert reader.resolve(db, "last") == SECOND
        with pytest.raises(LogError, match=f"2 sessions begin with '2026', among them {FIRST} and {SECOND}"):
            reader.load(db, "2026")
        with pytest.raises(LogError, match=f"among the 2 of .*did you mean {FIRST}"):
            reader.load(db, "20261122-013145-7f3b")
        with pytest.raises(LogError, match="`trainer sessions list`"):
            reader.load(db, "x")


def test_an_empty_log_says_so(tmp_path: Path) -> None:
    with create_log(tmp_path / "s.db") as db, pytest.raises(LogError, match="holds no session yet"):
        reader.load(db, "last")


@pytest.mark.parametrize(
    ("sql", "said"),
    [
        ("update inputs set data = x'0102'", "zlib|incorrect header|Error"),
        ("delete from inputs", "tool poses of 0 ticks only, 1 were"),
        ("insert into inputs select session, 100, ticks, data from inputs", "ticks 12 to 99 are missing"),
        ("update events set kind = 'sneeze' where tick = 0", "unknown kind of event 'sneeze'"),
        ("update events set data = '{' where tick = 0", "Expecting"),
        ("update events set data = '{}' where tick = 0", "missing .* required"),
    ],
)
def test_damaged_rows_name_the_session(tmp_path: Path, sql: str, said: str) -> None:
    path = tmp_path / "s.db"
    write(path, FIRST, ticks=1)
    execute(path, f"update inputs set ticks = 12, data = x'{zlib.compress(bytes(12 * 2 * 9 * 8)).hex()}'")
    execute(path, sql)
    with open_log(path) as db, pytest.raises(LogError, match=f"session {FIRST}: .*({said})"):
        reader.load(db, FIRST)


def test_renaming_a_person_changes_no_session(path: Path) -> None:
    execute(path, "update trainees set name = 'P-01' where name = 'Ana'")
    with open_log(path) as db:
        assert reader.header(db, FIRST) == replace(header(FIRST), trainee="P-01")
