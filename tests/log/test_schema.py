"""The tables refuse what does not belong in them, and a file that is no log is told apart."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from sqlite_utils import Database, Migrations

from tests.log.log_samples import execute, write
from trainer.log import reader, schema, seal
from trainer.log.recovery import recover
from trainer.log.schema import LogError, create_log, default_db_path, migrate, new_session_id, open_log, trainee_name

SESSION = "20261122-013145-7f3a"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    write(tmp_path / "s.db", SESSION)
    return tmp_path / "s.db"


def test_a_text_where_a_number_belongs_is_refused(path: Path) -> None:
    with (
        open_log(path) as db,
        pytest.raises(sqlite3.IntegrityError, match=r"TEXT value in INTEGER column events\.tick"),
    ):
        schema.table(db, "events").insert(
            {"session": SESSION, "tick": "soon", "seq": 0, "time_s": 0.0, "tool": "", "kind": "drop", "data": "{}"}
        )


def test_every_table_is_strict(path: Path) -> None:
    with open_log(path) as db:
        ours = {t.name: t.strict for t in db.tables if not t.name.startswith(("_", "sqlite_"))}
    assert ours == dict.fromkeys(("trainees", "sessions", "events", "inputs", "metrics", "chains"), True)


def test_nothing_belongs_to_a_session_or_trainee_that_does_not_exist(path: Path) -> None:
    with open_log(path) as db:
        for sql in (
            "insert into events values ('nobody', 0, 0, 0.0, '', 'drop', '{}')",
            "insert into inputs values ('nobody', 0, 1, x'00')",
            "insert into metrics values ('nobody', 'm', 1.0, 'mm', null, null, '', '1')",
            "update sessions set trainee = 99",
            "delete from sessions",
        ):
            with pytest.raises(sqlite3.IntegrityError, match="FOREIGN KEY"):
                db.execute(sql)


@pytest.fixture
def read_only(path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The log, killed in mid-session, in a folder where nothing may be changed; root would not be asked."""
    execute(path, "update sessions set status = 'running', hash = null, pid = 0, heartbeat = 0.0")
    path.chmod(0o444)
    path.parent.chmod(0o555)
    monkeypatch.setattr(os, "access", lambda *_: False)
    yield path
    path.parent.chmod(0o755)


def test_a_read_only_log_is_read_and_left_alone(read_only: Path) -> None:
    """No byte of the file changes, no file appears beside it, and nobody is declared dead in it."""
    before = read_only.read_bytes(), sorted(read_only.parent.iterdir())
    with open_log(read_only) as db:
        assert recover(db) == []
        assert [s.status for s in reader.list_sessions(db)] == ["running"]
        assert reader.load(db, "last").header.id == SESSION
        assert len(seal.check(db)) == 1  # only the unsealed session that the chain ends with
        assert sorted(read_only.parent.iterdir()) == before[1]
        with pytest.raises(sqlite3.OperationalError, match="readonly"):
            db.execute("delete from metrics")
    assert (read_only.read_bytes(), sorted(read_only.parent.iterdir())) == before


def test_a_read_only_log_is_not_practised_into(read_only: Path) -> None:
    with pytest.raises(LogError, match=r"s\.db: cannot be written; make the file and its folder writable"):
        create_log(read_only)


def test_a_read_only_log_that_is_being_written_is_read_whole(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What somebody else has committed lies beside the log until it is merged."""
    with open_log(path) as writer:
        with writer.atomic():
            writer.execute("update sessions set reason = 'just now'")
        assert path.with_name("s.db-wal").stat().st_size > 0
        monkeypatch.setattr(os, "access", lambda *_: False)
        with open_log(path) as db:
            assert reader.summary(db, SESSION).reason == "just now"


@pytest.mark.parametrize("name", ["Ana", "Ana María Núñez", "李小龙", "x" * 100, "O'Neill; drop table"])
def test_a_name_is_stored_without_blanks_around_it(name: str) -> None:
    assert trainee_name(f" {name}\t") == name


@pytest.mark.parametrize("name", ["", " \n", "x" * 101, "a\nb", "a\x1b[0m", "a\0b", "a\u2028b", "\udce9"])
def test_what_is_no_name_is_refused_in_one_line(name: str) -> None:
    with pytest.raises(LogError, match="a trainee's name") as caught:
        trainee_name(name)
    assert str(caught.value).isprintable()


def test_journal_is_write_ahead(path: Path) -> None:
    with open_log(path) as db:
        assert db.journal_mode == "wal"


def test_sessions_hold_no_name_of_a_person(path: Path) -> None:
    with open_log(path) as db:
        for name in ("sessions", "events", "inputs", "metrics", "chains"):
            assert "Ana" not in str(list(schema.table(db, name).rows))


def test_session_ids_differ_and_sort_by_time(monkeypatch: pytest.MonkeyPatch) -> None:
    ids = {new_session_id() for _ in range(20)}
    assert len(ids) > 1  # 16 random bits: 20 equal ones in 65536 ** 19
    early = new_session_id()

    class Later(schema.datetime):
        @classmethod
        def now(cls, tz: object = None) -> Later:  # type: ignore[override]
            return cls(2999, 1, 1, tzinfo=schema.UTC)

    monkeypatch.setattr(schema, "datetime", Later)
    assert new_session_id() > early


def test_default_log_is_the_one_named_by_the_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("TRAINER_DB", str(tmp_path / "mine.db"))
    assert default_db_path() == tmp_path / "mine.db"
    monkeypatch.delenv("TRAINER_DB")
    assert default_db_path().parts[-2:] == ("trainer", "sessions.db")


def test_a_missing_log_is_not_made_by_reading(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"s\.db: no log here"):
        open_log(tmp_path / "s.db")
    assert not (tmp_path / "s.db").exists()


def test_a_file_that_is_no_database(tmp_path: Path) -> None:
    (tmp_path / "s.db").write_text("dear diary, " * 50)
    for opening in (open_log, create_log, migrate):
        with pytest.raises(LogError, match=r"s\.db: not a log: not an SQLite file"):
            opening(tmp_path / "s.db")
    assert (tmp_path / "s.db").read_text().startswith("dear diary")


def test_the_database_of_another_program_is_left_alone(tmp_path: Path) -> None:
    execute(tmp_path / "s.db", "create table recipes (name text)")
    before = (tmp_path / "s.db").read_bytes()
    for opening in (open_log, create_log, migrate):
        with pytest.raises(LogError, match=r"s\.db: not a log: an SQLite file of another program"):
            opening(tmp_path / "s.db")
    assert (tmp_path / "s.db").read_bytes() == before


def test_an_older_log_says_how_to_migrate_and_migrates(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    newer = Migrations("trainer")
    newer._migrations = list(schema.migrations._migrations)

    @newer()
    def m999_one_column_more(db: Database) -> None:
        schema.table(db, "trainees").add_column("cohort", str)

    monkeypatch.setattr(schema, "migrations", newer)
    with pytest.raises(LogError, match=r"older version; run .* `trainer db migrate`"):
        open_log(path)
    assert migrate(path) == ["m999_one_column_more"]
    with open_log(path) as db:
        assert "cohort" in schema.table(db, "trainees").columns_dict
    assert migrate(path) == []


def test_a_newer_log_is_refused(path: Path) -> None:
    execute(path, "insert into _sqlite_migrations values (99, 'trainer', 'm999', '3000-01-01')")
    for opening in (open_log, create_log, migrate):
        with pytest.raises(LogError, match="newer version") as refused:
            opening(path)
        assert "pip" not in str(refused.value)  # the registry's package of this name is somebody else's


@pytest.mark.parametrize("write_ahead", [False, True], ids=["of no bytes", "without a table"])
def test_a_log_that_was_only_begun_holds_no_sessions(tmp_path: Path, write_ahead: bool) -> None:
    """Ctrl-C in the first moment leaves such a file; the next practice makes the log of it."""
    path = tmp_path / "s.db"
    path.touch()
    if write_ahead:
        execute(path, "pragma journal_mode = wal")
        assert path.stat().st_size > 0
    for opening in (open_log, migrate):
        with pytest.raises(LogError, match=r"s\.db: holds no sessions yet; `trainer practice` logs the first"):
            opening(path)
    create_log(path).close()
    with open_log(path) as db:
        assert reader.list_sessions(db) == []


def test_a_log_whose_columns_lost_their_names_is_damaged(path: Path) -> None:
    """One changed byte in the text of the schema does that."""
    execute(path, "alter table _sqlite_migrations rename column name to nbme")
    with pytest.raises(LogError, match=r"s\.db: damaged; restore a copy"):
        open_log(path)


def test_a_path_that_is_no_text_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"udcff.db': a log's path must be plain text"):
        create_log(tmp_path / "a\udcff.db")
    assert list(tmp_path.iterdir()) == []


def test_two_programs_may_make_the_log_at_once(tmp_path: Path) -> None:
    """The second finds the tables of the first, or waits for them; neither sees half of them."""
    with ThreadPoolExecutor(4) as pool:
        made = [pool.submit(lambda: create_log(tmp_path / "s.db").close()) for _ in range(4)]
    for m in made:
        m.result()
    open_log(tmp_path / "s.db").close()


def test_a_damaged_log_names_the_way_out(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[100:4096] = b"\xff" * 3996  # the page that holds the schema
    path.write_bytes(data)
    with pytest.raises(LogError, match=r"damaged.*`trainer db backup`"):
        open_log(path)
