"""``trainer db``: is the log as it was written, a copy of it, and its next version."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from trainer.cli.sessions import DbOption, JsonOption

app = typer.Typer(help="The log itself.", no_args_is_help=True)


@app.command()
def check(db: DbOption = None, as_json: JsonOption = False) -> None:
    """Compare every session with its seal; exit code 1 when one was changed, removed or damaged.

    The names of people are outside the seals, so that a name can be changed or erased.
    """
    from trainer.log import seal
    from trainer.log.schema import default_db_path, open_log

    path = db or default_db_path()
    with open_log(path) as log:
        problems = seal.check(log)
        counted = log.conn.execute("select count(*) from sessions").fetchone()[0]
    if as_json:
        print(json.dumps({"db": str(path), "sessions": counted, "problems": problems}, indent=2))
    elif not problems:
        print(f"{path}: {counted} sessions, each as it was sealed")
    if problems:
        for problem in () if as_json else problems:
            typer.echo(problem, err=True)
        raise typer.Exit(1)


@app.command()
def backup(
    target: Annotated[Path, typer.Argument(metavar="PATH", help="The copy to be made; must not exist.")],
    db: DbOption = None,
) -> None:
    """Copy the log, also while a session is being written."""
    from trainer.log.backup import backup as copy
    from trainer.log.schema import default_db_path

    path = db or default_db_path()
    copy(path, target)
    print(f"{target}: a copy of {path}")


@app.command()
def migrate(db: DbOption = None) -> None:
    """Bring the tables of an older log up to date."""
    from trainer.log import schema

    path = db or schema.default_db_path()
    steps = schema.migrate(path)
    print(f"{path}: {', '.join(steps) if steps else 'up to date already'}")
