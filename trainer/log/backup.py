"""A copy of the log, made by SQLite's own backup: whole even while a session is being written."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

from trainer.log.schema import LogError, clear_errors, open_log


def backup(path: Path, target: Path) -> None:
    """Copy the log at ``path`` to the new file ``target``. Raises LogError; leaves no half copy behind."""
    with open_log(path) as db:
        with clear_errors(target):
            try:
                target.touch(exist_ok=False)
            except FileExistsError:
                raise LogError(f"{target}: exists already; name a new file") from None
        try:
            with clear_errors(target), closing(sqlite3.connect(target)) as copy:
                db.conn.backup(copy)
        except BaseException:
            target.unlink()
            raise
