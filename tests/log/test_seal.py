"""A log that was changed after a session ended shows where."""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
from contextlib import closing
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.log.log_samples import execute, write
from trainer.log import schema, seal
from trainer.log.schema import open_log

IDS = ("20261122-010000-000a", "20261122-020000-000b", "20261122-030000-000c")
OTHER = "20261122-040000-000d"
SESSION = IDS[1]
KEYS = {"sessions": "id", "events": "session", "inputs": "session", "metrics": "session"}
COLUMNS = [(t, c) for t, columns in seal.SEALED.items() for c in columns] + [("sessions", "hash")]


@pytest.fixture(scope="module")
def sealed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three sessions of one trainee with one of another between them."""
    path = tmp_path_factory.mktemp("seal") / "s.db"
    order = ((IDS[0], "Ana"), (OTHER, "Bo"), (IDS[1], "Ana"), (IDS[2], "Ana"))
    for number, (session, trainee) in enumerate(order):
        write(path, session, ticks=9 + number, trainee=trainee, recording="r.rrd")
    return path


@pytest.fixture
def path(sealed: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(sealed, tmp_path / "s.db"))


def problems(path: Path) -> list[str]:
    with open_log(path) as db:
        return seal.check(db)


def test_an_untouched_log_has_no_problem(path: Path) -> None:
    assert problems(path) == []


def test_the_seal_covers_every_column_but_itself(path: Path) -> None:
    with open_log(path) as db:
        for name, columns in seal.SEALED.items():
            assert set(columns) | {"hash"} == set(schema.table(db, name).columns_dict) | {"hash"}


def test_seals_are_chained_for_each_trainee(path: Path) -> None:
    with open_log(path) as db:
        rows = {r["id"]: r for r in schema.table(db, "sessions").rows}
    assert (rows[IDS[0]]["previous"], rows[IDS[0]]["previous_hash"]) == (None, None)
    assert (rows[OTHER]["previous"], rows[OTHER]["previous_hash"]) == (None, None)
    for before, after in ((IDS[0], IDS[1]), (IDS[1], IDS[2])):
        assert (rows[after]["previous"], rows[after]["previous_hash"]) == (before, rows[before]["hash"])


@pytest.mark.parametrize(("name", "column"), COLUMNS)
def test_one_changed_value_names_the_session(path: Path, name: str, column: str) -> None:
    """Every column of every table: another number, one letter more, a value where there was none."""
    with closing(sqlite3.connect(path)) as connection, connection:
        (kind,) = connection.execute(
            "select type from pragma_table_info(?) where name = ?", (name, column)
        ).fetchone()  # fmt: skip
        text = f"coalesce({column}, '') || 'x'"
        changed = {
            "INTEGER": f"{column} + 1000",
            "REAL": f"coalesce({column}, 0) * (1 + 1e-12) + 1e-12",
            "TEXT": text,
        }.get(kind, f"cast({text} as blob)")
        count = connection.execute(
            f"update {name} set {column} = {changed} where rowid = "
            f"(select max(rowid) from {name} where {KEYS[name]} = ?)",
            (SESSION,),
        ).rowcount
    assert count == 1
    assert any(SESSION in p for p in problems(path))


@pytest.mark.parametrize("name", ["events", "inputs", "metrics"])
@pytest.mark.parametrize("which", ["min", "max"])
def test_a_removed_row_names_the_session(path: Path, name: str, which: str) -> None:
    execute(path, f"delete from {name} where rowid = (select {which}(rowid) from {name} where session = ?)", (SESSION,))
    assert [p for p in problems(path) if SESSION in p]


@pytest.mark.parametrize("name", ["events", "inputs", "metrics"])
def test_an_added_row_names_the_session(path: Path, name: str) -> None:
    column = {"events": "tick", "inputs": "first_tick", "metrics": "name"}[name]
    with closing(sqlite3.connect(path)) as connection, connection:
        columns = list(seal.SEALED[name])
        taken = [f"{c} || '7'" if c == column else c for c in columns]
        if column != "name":
            taken = [f"{c} + 7000" if c == column else c for c in columns]
        copied = f"select {', '.join(taken)} from {name} where session = ? limit 1"
        connection.execute(f"insert into {name} ({', '.join(columns)}) {copied}", (SESSION,))
    assert [p for p in problems(path) if SESSION in p]


@pytest.mark.parametrize("gone", IDS)
@pytest.mark.parametrize("whole", [True, False])
def test_a_removed_session_is_named(path: Path, gone: str, whole: bool) -> None:
    """The first, one within and the last of a chain; with all of its rows or with the session's row alone."""
    for name in ("events", "inputs", "metrics") if whole else ():
        execute(path, f"delete from {name} where session = ?", (gone,))
    execute(path, "delete from sessions where id = ?", (gone,))
    assert [p for p in problems(path) if gone in p]


def test_sessions_that_change_places_are_named(path: Path) -> None:
    """Exchanging the rows of two sessions, so that both are whole, breaks both."""
    for table, key in (("events", "session"), ("inputs", "session"), ("metrics", "session")):
        for before, after in ((IDS[0], "swap"), (IDS[1], IDS[0]), ("swap", IDS[1])):
            execute(path, f"update {table} set {key} = ? where {key} = ?", (after, before))
    found = problems(path)
    assert any(IDS[0] in p for p in found)
    assert any(IDS[1] in p for p in found)


def test_a_session_resealed_alone_breaks_the_chain(path: Path) -> None:
    """Who changes a session and computes its own seal anew is told by the session after it."""
    execute(path, "update sessions set outcome = 'failed' where id = ?", (SESSION,))
    with open_log(path) as db:
        schema.table(db, "sessions").update(SESSION, {"hash": seal.digest(db.conn, SESSION)})
    assert problems(path) == [f"session {SESSION}: its seal is not the one that session {IDS[2]} follows"]


def test_an_unsealed_ended_session_is_named(path: Path) -> None:
    execute(path, "update sessions set hash = null where id = ?", (SESSION,))
    assert f"session {SESSION}: has no seal" in problems(path)


def test_a_chain_that_was_shortened_or_removed_names_what_it_left_out(path: Path) -> None:
    execute(path, "update chains set last = ? where last = ?", (SESSION, IDS[2]))
    assert problems(path) == [f"session {IDS[2]}: sealed, but not in the chain of its trainee"]
    execute(path, "delete from chains where trainee = 1")
    assert len(problems(path)) == 3


def test_a_text_that_is_no_longer_utf8_is_named(path: Path) -> None:
    execute(path, "update events set data = cast(x'ff' || cast(data as blob) as text) where session = ?", (SESSION,))
    assert problems(path) == [f"session {SESSION}: its rows are not those that were sealed"]


def rows(path: Path) -> dict[str, list[tuple[object, ...]]]:
    with closing(sqlite3.connect(path)) as connection:
        connection.text_factory = bytes
        tables = (*seal.SEALED, "chains")
        return {name: connection.execute(f"select * from {name} order by rowid").fetchall() for name in tables}


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_any_flipped_byte_of_the_file_is_reported_or_harmless(sealed: Path, data: st.DataObject) -> None:
    """Where the stored rows are no longer those that were written, the check says something.

    A byte in a page's unused space, a person's name or SQLite's own counters may change unseen.
    """
    content = bytearray(sealed.read_bytes())
    at = data.draw(st.integers(0, len(content) - 1))
    content[at] ^= data.draw(st.integers(1, 255))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "s.db"
        path.write_bytes(content)
        try:
            found = problems(path)
        except schema.LogError:
            return
        if not found:
            assert rows(path) == rows(sealed)
