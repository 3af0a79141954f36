"""``trainer bench``: how fast the program is on this machine, and how right."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from trainer.cli.sessions import JsonOption

if TYPE_CHECKING:
    from trainer.bench.realtime import Perform
    from trainer.bench.rows import Row
    from trainer.bench.soak import Observed
    from trainer.bench.soak import Perform as Practised
    from trainer.clock import Realtime
    from trainer.curriculum import TaskFile

OutOption = Annotated[
    Path | None,
    typer.Option(metavar="DIR", help="Where the report goes; by default reports/, or reports/quick/ if --quick."),
]

app = typer.Typer(help="Measure the program on this machine; without a command a short run of all.")


@app.callback(invoke_without_command=True)
def everything(context: typer.Context) -> None:
    """Measure the program on this machine; without a command a short run of all."""
    if context.invoked_subcommand is None:
        speed_error(quick=True)
        print()
        realtime(seconds=10.0)


@app.command()
def realtime(
    seconds: Annotated[float, typer.Option(min=0.1, help="How long.")] = 60.0,
    task: Annotated[str, typer.Option(metavar="FAMILY/TASK", help="What to run.")] = "anastomosis/single-stitch",
    as_json: JsonOption = False,
) -> None:
    """Run a task in real time, log and recording included, and tell the work of its ticks."""
    from tempfile import TemporaryDirectory

    from trainer.bench.machine import in_words, load
    from trainer.bench.realtime import measure
    from trainer.curriculum import load_task

    task_file = load_task(task)
    about = _machine()
    with TemporaryDirectory(prefix="trainer-bench-") as folder:
        found = measure(_session(task_file, Path(folder)), task_file.task.tick_hz, seconds)
    about["load_after"] = load()
    nodes = sum(2 * vessel.layers * vessel.around for vessel in task_file.task.scene.vessel)
    result = {"task": task_file.path, "nodes": nodes, **found, "machine": about}
    if as_json:
        print(json.dumps(result, indent=2, allow_nan=False))
        return
    print(f"{result['task']} in real time: {nodes} nodes, {found['ticks']} ticks at {found['tick_hz']:g} Hz")
    print(f"sessions       {', '.join(found['sessions'])}")
    print(
        f"work per tick  median {found['p50_ms']:.2f} ms, 99 % within {found['p99_ms']:.2f} ms, "
        f"longest {found['max_ms']:.2f} ms"
    )
    print(f"overruns       {found['overruns']}")
    print(f"machine        {in_words(about)}")


@app.command()
def haptics(
    seconds: Annotated[float, typer.Option(min=0.1, help="How long.")] = 60.0,
    task: Annotated[str, typer.Option(metavar="FAMILY/TASK", help="What runs beside.")] = "anastomosis/single-stitch",
    as_json: JsonOption = False,
) -> None:
    """Run the haptic loop beside a task in real time, and a bare sleeping loop, and compare their periods."""
    from tempfile import TemporaryDirectory

    from trainer.bench import haptics as loops
    from trainer.bench import realtime as sessions
    from trainer.bench.machine import in_words, load
    from trainer.curriculum import load_task

    task_file = load_task(task)
    about = _machine()
    with TemporaryDirectory(prefix="trainer-bench-") as folder:
        session = _session(task_file, Path(folder))
        found = loops.measure(lambda s: sessions.measure(session, task_file.task.tick_hz, s), seconds)
    about["load_after"] = load()
    result = {"task": task_file.path, "seconds": seconds, **found, "machine": about}
    if as_json:
        print(json.dumps(result, indent=2, allow_nan=False))
        return
    print(f"a haptic loop at {found['haptics']['rate_hz']:g} Hz beside {result['task']}; error of its periods, µs")
    for name, row in (("haptic loop", found["haptics"]), ("bare loop", found["bare"])):
        print(
            f"{name:<12} median {row['p50_us']:.0f}, 99 % within {row['p99_us']:.0f}, 99.9 % within "
            f"{row['p999_us']:.0f}, longest {row['max_us']:.0f} ({row['periods']} periods)"
        )
    print(f"99.9 %       {found['p999_ratio']:.2f} times the bare loop's")
    print(f"evaluation   {found['evaluation_us']:.2f} µs from Python")
    print(f"machine      {in_words(about)}")


@app.command("speed-error")
def speed_error(
    quick: Annotated[bool, typer.Option("--quick", help="About a minute: small meshes, few repetitions.")] = False,
    out: OutOption = None,
    as_json: JsonOption = False,
) -> None:
    """Time against error of every method of mechanics; writes speed_error.md, .svg and .json."""
    from trainer.bench import page
    from trainer.bench.machine import load
    from trainer.cli.warmup import announce

    folder = _folder(out, quick)
    announce()
    about = _machine()
    rows = page.measure(quick, _tell)
    about["load_after"] = load()
    written = page.write(folder, rows, about, quick)
    if as_json:
        print(json.dumps(page.document(rows, about, quick), indent=2, allow_nan=False))
    else:
        for name, of_subject in rows.items():
            _print_rows(page.SUBJECTS[name].counts, of_subject)
    for path in written:
        typer.echo(f"written: {path}", err=True)


def _print_rows(counts: str, rows: Sequence[Row]) -> None:
    from trainer.bench import page
    from trainer.cli.sessions import print_table

    print_table(
        ("case", counts, "method", "setting", "median ms", "p90 ms", "error", "status"),
        [
            (
                r.case,
                str(r.size),
                r.method,
                r.setting,
                page.ms(r.median_ms),
                page.ms(r.p90_ms),
                page.size_of(r.error),
                r.status,
            )
            for r in rows
        ],
    )


@app.command("peers")
def swing_beside_peers(out: OutOption = None, as_json: JsonOption = False) -> None:
    """A swinging chain of 50 links, here and in MuJoCo and PyElastica, if installed beside; writes peers.md, .json."""
    from trainer.bench import page, peers, peers_page
    from trainer.bench.machine import load

    about = _machine()
    about["versions"].update(peers.installed())
    found = peers.measure()
    about["load_after"] = load()
    if as_json:
        print(json.dumps(peers_page.document(found, about), indent=2, allow_nan=False))
    else:
        _print_rows(page.SUBJECTS["thread"].counts, [s.row for s in found])
    if not all(s.rounds_ms for s in found):
        _tell("no report is written where a peer is not installed")
        return
    for path in peers_page.write(_folder(out, False), found, about):
        typer.echo(f"written: {path}", err=True)


@app.command()
def stability(
    quick: Annotated[
        bool, typer.Option("--quick", help="Within a minute once kernels are compiled: not the long cases.")
    ] = False,
    out: OutOption = None,
    as_json: JsonOption = False,
) -> None:
    """What becomes of hard cases; writes stability.md. Exit code 1 when a law is broken."""
    from trainer.bench import stability as hard
    from trainer.bench.machine import load
    from trainer.cli.sessions import print_table
    from trainer.cli.warmup import announce

    folder = _folder(out, quick)
    announce()
    about = _machine()
    outcomes = hard.measure(quick, _tell)
    about["load_after"] = load()
    written = hard.write(folder, outcomes, about, quick)
    if as_json:
        print(json.dumps(hard.document(outcomes, about, quick), indent=2, allow_nan=False))
    else:
        for of_subject in outcomes.values():
            rows = [(o.case, o.method, o.outcome, f"{o.seconds:.2f}") for o in of_subject]
            print_table(("case", "method", "outcome", "s"), rows)
        print(hard.in_numbers(outcomes))
    typer.echo(f"written: {written}", err=True)
    if hard.counts(outcomes)["BROKEN"]:
        raise typer.Exit(1)


@app.command()
def soak(
    minutes: Annotated[float, typer.Option(min=0.01, help="How long.")] = 30.0,
    quick: Annotated[bool, typer.Option("--quick", help="One minute.")] = False,
    task: Annotated[str, typer.Option(metavar="FAMILY/TASK", help="What to practise.")] = "anastomosis/single-stitch",
    out: OutOption = None,
    as_json: JsonOption = False,
) -> None:
    """Practise through simulated trackers for long: memory, queues, latency, drift; writes realtime.md and .json."""
    from tempfile import TemporaryDirectory

    from trainer.bench import soak as station
    from trainer.bench import soak_page as page
    from trainer.bench.machine import load
    from trainer.curriculum import load_task

    task_file, minutes = load_task(task), 1.0 if quick else minutes
    hz = task_file.task.tick_hz
    about = _machine()
    with TemporaryDirectory(prefix="trainer-bench-") as name:
        folder = Path(name)
        found = station.Soak()
        try:
            motion = _stitched(task_file, folder)
            found = station.Soak()
            station.measure(found, _practised(task_file, folder, minutes), folder, motion, hz, minutes, _tell)
        except KeyboardInterrupt:
            _tell("stopped; this is what was measured")
    about["load_after"] = load()
    result = page.document(found, minutes, hz, about)
    written = page.write(_folder(out, quick), result, quick)
    if as_json:
        print(json.dumps(result, indent=2, allow_nan=False))
    else:
        for what, value in page.rows(result):
            print(f"{what:<17} {value}")
    for path in written:
        typer.echo(f"written: {path}", err=True)


def _tell(line: str) -> None:
    typer.echo(f"trainer: {line}", err=True)


def _stitched(task_file: TaskFile, folder: Path) -> str:
    """The scripted expert performs the task once, without pauses; what ``devices simulate --motion`` takes."""
    from contextlib import ExitStack

    from trainer.cli.practice import Asked, perform
    from trainer.clock import Fast
    from trainer.log.schema import new_session_id

    log_path, session_id = folder / "motion.db", new_session_id()
    with ExitStack() as stack:
        asked = Asked(task_file, session_id, "bench", "scripted-expert", 0, log_path)
        perform(stack, asked, Fast(task_file.task.tick_hz))
    return f"{log_path}#{session_id}"


def _practised(task_file: TaskFile, folder: Path, minutes: float) -> Practised:
    """Performs the task by a device, log and recording included; a recording is removed with its session's end."""
    from contextlib import ExitStack

    from trainer.bench.soak import with_rest
    from trainer.cli.practice import Asked, perform
    from trainer.curriculum import parse_task
    from trainer.log.schema import new_session_id

    text = with_rest(task_file.text, minutes)
    resting = replace(task_file, text=text, task=parse_task(text, task_file.path))

    def session(
        profile: Path, clock: Realtime, enough: Callable[[], bool], observed: Observed, long: bool
    ) -> dict[str, Any]:
        session_id = new_session_id()
        recording = folder / f"{session_id}.rrd"
        task = resting if long else task_file
        asked = Asked(task, session_id, "bench", str(profile), 0, folder / "log.db", recording)
        with ExitStack() as stack:
            done = perform(stack, asked, clock, enough, observed)
        recording.unlink()
        return done

    return session


def _session(task_file: TaskFile, folder: Path) -> Perform:
    """Performs one session of a task by the scripted expert, log and recording in ``folder``."""
    from contextlib import ExitStack

    from trainer.cli.practice import Asked, perform
    from trainer.log.schema import new_session_id

    def session(seed: int, clock: Realtime, enough: Callable[[], bool]) -> str:
        session_id = new_session_id()
        log_path, recording = folder / "log.db", folder / f"{session_id}.rrd"
        asked = Asked(task_file, session_id, "bench", "scripted-expert", seed, log_path, recording)
        with ExitStack() as stack:
            done = perform(stack, asked, clock, enough)
        return str(done["outcome"])

    return session


def _folder(out: Path | None, quick: bool) -> Path:
    """Where a report goes: a short run does not replace the whole one, by which methods are chosen."""
    if out is not None:
        return out
    here = Path("reports") if Path("reports").is_dir() else Path()
    return here / "quick" if quick else here


def _machine() -> dict[str, Any]:
    from trainer.bench.machine import machine
    from trainer.cli.practice import versions

    return {**machine(), "versions": versions()}
