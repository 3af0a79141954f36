"""``trainer sessions``: what was practised, how it was scored, and whether it can be run again."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from sqlite_utils import Database

    from trainer.log.reader import Summary
    from trainer.log.record import Metric, SessionRecord

app = typer.Typer(help="What was practised.", no_args_is_help=True)

DbOption = Annotated[
    Path | None, typer.Option("--db", metavar="PATH", help="The log; default: TRAINER_DB or the user's data folder.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")]
SessionArgument = Annotated[str, typer.Argument(metavar="ID", help="A session, the beginning of its id, or 'last'.")]


@app.command("list")
def list_(
    trainee: Annotated[str | None, typer.Option(metavar="NAME", help="Only this trainee's.")] = None,
    db: DbOption = None,
    as_json: JsonOption = False,
) -> None:
    """List the sessions, oldest first."""
    from trainer.log import reader

    with opened(db) as log:
        found = reader.list_sessions(log, trainee)
    if as_json:
        print(json.dumps([_summary_json(s) for s in found], indent=2))
        return
    several = len({s.anatomy for s in found} - {""}) > 1  # then the task alone does not tell what was practised
    rows = [
        (s.id, _local(s.started_at), s.trainee, f"{s.task} in {s.anatomy}" if several and s.anatomy else s.task,
         s.device, _ending(s), f"{s.duration_s:.1f} s")
        for s in found
    ]  # fmt: skip
    print_table(("session", "started", "trainee", "task", "device", "outcome", "duration"), rows)


@app.command()
def show(
    session: SessionArgument,
    events: Annotated[bool, typer.Option("--events", help="Every event too.")] = False,
    db: DbOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show what a session was, how it ended, what happened and how it was scored."""
    from trainer.log import reader
    from trainer.reporting.wording import out_of_sight

    with opened(db) as log:
        summary = reader.summary(log, session)
        record = reader.load(log, summary.id)
        metrics = reader.stored_metrics(log, summary.id)
    if as_json:
        print(json.dumps(_session_json(summary, record, metrics, events), indent=2))
        return
    header = record.header
    task = f"{header.task} in {header.anatomy}" if header.anatomy else header.task
    print(f"{summary.id}: {task} by {header.trainee}, {_ending(summary)} after {summary.duration_s:.2f} s")
    if summary.reason:
        print(f"  reason     {summary.reason}")
    print(f"  started    {_local(header.started_at)}")
    print(f"  device     {header.device}, seed {header.seed}")
    print(f"  ticks      {summary.ticks} at {header.tick_hz:g} Hz, tools {', '.join(header.tools)}")
    print(f"  versions   {_versions(record)}")
    print(f"  recording  {header.recording or 'none'}")
    print(f"  events     {', '.join(f'{n} {kind}' for kind, n in _counts(record).items()) or 'none'}")
    if lost := out_of_sight(record.events):
        print(f"  unseen     {lost}")
    if events:
        print_table(("tick", "time", "tool", "kind", "what"), [_event_row(e) for e in record.events])
    print_metrics(metrics)


@app.command()
def score(session: SessionArgument, db: DbOption = None, as_json: JsonOption = False) -> None:
    """Compute a session's scores again from the log."""
    from dataclasses import asdict

    from trainer import curriculum
    from trainer.log import reader
    from trainer.metrics import score as scored

    with opened(db) as log:
        record = reader.load(log, session)
    metrics = scored(record, curriculum.parse_task(record.header.task_toml, record.header.task))
    if as_json:
        print(json.dumps([asdict(m) for m in metrics], indent=2))
    else:
        print_metrics(metrics)


@app.command()
def replay(
    session: SessionArgument,
    verify: Annotated[bool, typer.Option("--verify", help="Compare with the recorded events; exit code 1.")] = False,
    db: DbOption = None,
    as_json: JsonOption = False,
) -> None:
    """Simulate a session again from its stored tool poses."""
    from rich.console import Console
    from rich.progress import track

    from trainer.log import reader
    from trainer.resimulation import first_difference, resimulate

    with opened(db) as log:
        record = reader.load(log, session)
    console = Console(stderr=True)
    ticks = range(record.ticks)
    again = resimulate(
        record, track(ticks, "replaying", console=console, transient=True, disable=not console.is_terminal)
    )
    difference = first_difference(record.events, again) if verify else None
    counts = dict(Counter(e.kind for e in again))
    if as_json:
        answer: dict[str, Any] = {"session": record.header.id, "ticks": len(ticks), "events": counts}
        if verify:
            answer |= {"identical": difference is None, "difference": difference}
        print(json.dumps(answer, indent=2))
    else:
        print(f"{record.header.id}: {len(ticks)} ticks gave {', '.join(f'{n} {kind}' for kind, n in counts.items())}")
        if verify and difference is None:
            print("identical: the same events bit for bit")
    if difference is not None:
        typer.echo(f"not the same: {difference}\nrecorded with {_versions(record)}", err=True)
        raise typer.Exit(1)


@app.command()
def view(session: SessionArgument, db: DbOption = None) -> None:
    """Open a session's recording in the rerun viewer."""
    import os
    import subprocess
    import sys

    from trainer.log import reader
    from trainer.log.schema import LogError

    with opened(db) as log:
        found = reader.summary(log, session)
    if found.recording is None:
        raise LogError(
            f"session {found.id} was made without a recording; `trainer practice --record PATH.rrd` makes one"
        )
    if not Path(found.recording).is_file():
        raise LogError(f"{found.recording}: the recording of session {found.id} is gone; the log still has its events")
    # The viewer itself ends without a display as if all were well.
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise LogError(f"{found.recording}: no display to show it on here; copy it to a machine that has one")
    # The viewer listens for more data; without --bind it would do so on every network.
    raise typer.Exit(subprocess.call([sys.executable, "-m", "rerun_cli", found.recording, "--bind", "127.0.0.1"]))


#: Columns of a screen; with fewer a list of sessions has no room for its seven.
NARROW = 80


@contextmanager
def opened(path: Path | None) -> Iterator[Database]:
    """The log that an option names; sessions that were interrupted are closed first, and told about on stderr."""
    from trainer.log.recovery import recover
    from trainer.log.schema import default_db_path, open_log

    with open_log(path or default_db_path()) as log:
        for interrupted in recover(log):
            typer.echo(str(interrupted), err=True)
        yield log


def print_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Rows under a head. The first column is never broken, and nothing is where nobody looks at a screen.

    On a narrow screen, where a table would have no room for most of its columns, each row is a paragraph.
    """
    import sys

    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console(width=None if sys.stdout.isatty() else 1000)
    if console.width < NARROW:
        for first, *others in rows:
            console.print(Text(first))
            for title, cell in zip(head[1:], others, strict=True):
                console.print(Text(f"  {title}: {cell}"))
        return
    table = Table(box=box.SIMPLE_HEAD)
    for number, title in enumerate(head):
        table.add_column(title, no_wrap=number == 0)
    for row in rows:
        table.add_row(*map(Text, row))
    console.print(table)


def print_metrics(metrics: Sequence[Metric]) -> None:
    """Scores as a table, with their target bands."""
    from trainer.reporting.wording import band, number

    rows = [
        (
            m.name,
            "nothing measured" if m.value is None else f"{number(m.value, m.unit)} {m.unit}",
            band(m.target_low, m.target_high, m.unit),
            m.source,
        )
        for m in metrics
    ]
    if rows:
        print_table(("metric", "value", "target", "source of the target"), rows)


def _summary_json(summary: Summary) -> dict[str, Any]:
    from dataclasses import asdict

    values = asdict(summary)
    return {"session": values.pop("id"), **values}


def _session_json(summary: Summary, record: SessionRecord, metrics: Sequence[Metric], events: bool) -> dict[str, Any]:
    from dataclasses import asdict

    header = record.header
    answer = {
        **_summary_json(summary),
        "task_sha256": header.task_sha256,
        "device_sha256": header.device_sha256,
        "tick_hz": header.tick_hz,
        "tools": header.tools,
        "versions": header.versions,
        "events": _counts(record),
        "metrics": [asdict(m) for m in metrics],
    }
    if events:
        answer["event_list"] = [{"kind": e.kind, **asdict(e)} for e in record.events]
    return answer


def _counts(record: SessionRecord) -> dict[str, int]:
    return dict(Counter(e.kind for e in record.events))


def _event_row(event: Any) -> tuple[str, ...]:
    from trainer.events import payload

    what = ", ".join(f"{k} {_shown(v)}" for k, v in json.loads(payload(event)).items())
    return f"{event.tick}.{event.seq}", f"{event.time_s:.3f} s", event.tool, event.kind, what


def _shown(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    return f"({', '.join(map(_shown, value))})" if isinstance(value, list) else str(value)


def _ending(summary: Summary) -> str:
    return summary.outcome or summary.status


def _versions(record: SessionRecord) -> str:
    return ", ".join(f"{name} {version}" for name, version in record.header.versions.items())


def _local(started_at: str) -> str:
    """A stored time as the clock on the wall shows it."""
    from datetime import datetime

    return f"{datetime.fromisoformat(started_at).astimezone():%Y-%m-%d %H:%M}"
