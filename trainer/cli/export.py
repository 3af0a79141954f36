"""``trainer export``: sessions in formats that other programs read."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from trainer.cli.sessions import DbOption, JsonOption, opened

app = typer.Typer(help="Sessions in formats that other programs read.", no_args_is_help=True)


@app.callback()
def formats() -> None:
    """Sessions in formats that other programs read."""


@app.command("csv")
def csv_(
    out: Annotated[Path, typer.Option(metavar="DIR", help="A new or empty folder.")],
    trainee: Annotated[str | None, typer.Option(metavar="NAME", help="Only this trainee's.")] = None,
    db: DbOption = None,
    as_json: JsonOption = False,
) -> None:
    """Write sessions.csv, events.csv, metrics.csv and poses.csv."""
    from trainer.exports import csv_files
    from trainer.log import reader

    with opened(db) as log:
        found = reader.list_sessions(log, trainee)
        if not found:
            raise csv_files.ExportError("the log holds no session yet; nothing was written")
        rows = csv_files.write((reader.load(log, s.id) for s in found), out)
    if as_json:
        print(json.dumps({"folder": str(out), "rows": rows}, indent=2))
        return
    for name, count in rows.items():
        print(f"{out / name}: {count} rows")
