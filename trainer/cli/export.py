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


OutOption = Annotated[Path, typer.Option(metavar="DIR", help="A new or empty folder.")]
TraineeOption = Annotated[str | None, typer.Option(metavar="NAME", help="Only this trainee's.")]


@app.command("csv")
def csv_(
    out: OutOption,
    trainee: TraineeOption = None,
    db: DbOption = None,
    as_json: JsonOption = False,
) -> None:
    """Write sessions.csv, events.csv, metrics.csv and poses.csv."""
    from trainer.exports import csv_files
    from trainer.exports.files import ExportError
    from trainer.log import reader

    with opened(db) as log:
        found = reader.list_sessions(log, trainee)
        if not found:
            raise ExportError("the log holds no session yet; nothing was written")
        rows = csv_files.write((reader.load(log, s.id) for s in found), out)
    if as_json:
        print(json.dumps({"folder": str(out), "rows": rows}, indent=2))
        return
    for name, count in rows.items():
        print(f"{out / name}: {count} rows")


@app.command("igs-mha")
def igs_mha(out: OutOption, trainee: TraineeOption = None, db: DbOption = None, as_json: JsonOption = False) -> None:
    """Write each session's tool poses as a PLUS/3D Slicer sequence file, SESSION.igs.mha."""
    from trainer.exports import motion_files
    from trainer.exports.files import ExportError, make_room
    from trainer.log import reader

    frames: dict[str, int] = {}
    with opened(db) as log:
        found = reader.list_sessions(log, trainee)
        if not found:
            raise ExportError("the log holds no session yet; nothing was written")
        make_room(out)
        for session in found:
            motion = motion_files.of_session(reader.load(log, session.id))
            if len(motion.time) == 0:
                typer.echo(f"trainer: session {session.id} holds no tool poses and was left out", err=True)
                continue
            frames[f"{session.id}.igs.mha"] = motion_files.write_sequence(motion, out / f"{session.id}.igs.mha")
    if as_json:
        print(json.dumps({"folder": str(out), "frames": frames}, indent=2))
        return
    for name, count in frames.items():
        print(f"{out / name}: {count} frames")


@app.command()
def recording(
    path: Annotated[str, typer.Argument(metavar="PATH", help="A recording: .mha, .nrrd, .txt, .xml or .csv.")],
    out: Annotated[Path, typer.Option(metavar="FILE", help="A new file, .igs.mha or .csv.")],
    as_json: JsonOption = False,
) -> None:
    """Write a recording of any format again as a PLUS/3D Slicer sequence file or as a CSV table."""
    from trainer.drivers.motion_file import read
    from trainer.exports.files import ExportError
    from trainer.exports.motion_files import WRITERS

    writer = next((write for end, write in WRITERS.items() if out.name.endswith(end)), None)
    if writer is None:
        raise ExportError(f"{out}: no format for this; give --out a name that ends in {' or '.join(WRITERS)}")
    motion = read(path)
    rows = writer(motion, out)
    if as_json:
        print(json.dumps({"file": str(out), "rows": rows, "sensors": motion.sensors}, indent=2))
        return
    print(f"{out}: {rows} rows of {', '.join(motion.sensors)}")
