"""``trainer report``: what a trainee and a supervisor read."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from trainer.cli.sessions import DbOption, JsonOption, SessionArgument, opened

app = typer.Typer(help="What a trainee and a supervisor read.", no_args_is_help=True)

HtmlOption = Annotated[
    Path | None, typer.Option("--html", metavar="PATH", help="Write one self-contained page, fit for A4 paper.")
]


@app.command()
def session(
    reference: SessionArgument, html: HtmlOption = None, db: DbOption = None, as_json: JsonOption = False
) -> None:
    """Report one session: its scores against their targets, its stitches and what happened."""
    from dataclasses import asdict

    from trainer.curriculum import parse_task
    from trainer.log import reader
    from trainer.reporting.page import session_page
    from trainer.reporting.session import session_report

    with opened(db) as log:
        record = reader.load(log, reference)
    report = session_report(record, parse_task(record.header.task_toml, record.header.task))
    if html is not None:
        write_page(html, session_page(report))
    if as_json:
        print(json.dumps(asdict(report), indent=2))
    elif html is None:
        from rich.console import Console

        from trainer.reporting.terminal import print_session

        print_session(report, Console(highlight=False))


@app.command()
def progress(
    trainee: Annotated[str, typer.Option(metavar="NAME", help="Whose progress.")],
    html: HtmlOption = None,
    db: DbOption = None,
    as_json: JsonOption = False,
) -> None:
    """Report how a trainee gets on: learning curves, last and best scores, stitches over the sessions."""
    from dataclasses import asdict

    from trainer.log import reader
    from trainer.reporting.page import progress_page
    from trainer.reporting.progress import progress_report

    with opened(db) as log:
        report = progress_report(reader.load(log, s.id) for s in reader.list_sessions(log, trainee))
    if html is not None:
        write_page(html, progress_page(report))
    if as_json:
        print(json.dumps(asdict(report), indent=2))
    elif html is None:
        from rich.console import Console

        from trainer.reporting.terminal import print_progress

        print_progress(report, Console(highlight=False))


def write_page(path: Path, page: str) -> None:
    """Write a page and tell where it is, on stderr; where that fails, what was there before stays. Raises OSError."""
    target = path.resolve()
    whole = target.is_file() or not target.exists()  # a pipe or a device has nothing to lose, and no other name
    part = target.with_name(f"{target.name}.part") if whole else target
    try:
        part.write_text(page, encoding="utf-8")
        if whole:
            part.replace(target)
    except OSError as error:
        if whole:
            with suppress(OSError):
                part.unlink()
        error.filename = str(path)  # a full disk names no file
        raise
    typer.echo(f"wrote {path}", err=True)
