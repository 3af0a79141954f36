"""``trainer practice``: one exercise, from the device to the scores."""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing, nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from trainer.anatomy.imported import Anatomy
    from trainer.choice import Choice
    from trainer.clock import Fast
    from trainer.curriculum import TaskFile
    from trainer.drivers.driver import Driver
    from trainer.log.record import SessionHeader
    from trainer.profile import ProfileFile
    from trainer.scene import Scene
    from trainer.sinks.log import LogSink
    from trainer.sinks.recording import RecordingSink
    from trainer.sinks.surface import Sink


def practice(
    task: Annotated[str, typer.Argument(metavar="FAMILY/TASK", help="What to practise, or a task's .toml file.")],
    trainee: Annotated[str, typer.Option(help="Who practises; the log keeps sessions by this name.")] = "anonymous",
    device: Annotated[
        str, typer.Option(metavar="PROFILE|PATH", help="A device's name or .toml file, or a recording.")
    ] = "scripted-expert",
    seed: Annotated[int, typer.Option(min=0, max=2**63 - 1, help="Seed of a scripted hand's chance.")] = 0,
    anatomy: Annotated[
        str, typer.Option(metavar="PATH", help="Another knee than the task's: a folder of `anatomy import`, or a name.")
    ] = "",
    realtime: Annotated[
        bool,
        typer.Option(
            "--realtime/--fast", help="At the task's pace, as always with a device in the hand, or without pauses."
        ),
    ] = True,
    record: Annotated[
        Path | None, typer.Option(metavar="PATH.rrd", help="The recording; by default in recordings/ beside the log.")
    ] = None,
    no_record: Annotated[bool, typer.Option("--no-record", help="Make no recording.")] = False,
    db: Annotated[
        Path | None, typer.Option(metavar="PATH", help="The log; by default TRAINER_DB or the user's data folder.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Run one exercise, log it and print its scores."""
    if record is not None and no_record:
        raise typer.BadParameter("--record and --no-record exclude each other")
    if record is not None and record.suffix != ".rrd":
        raise typer.BadParameter(f"--record needs a name that ends in .rrd, found {record}")
    if sys.stderr.isatty():  # what follows takes seconds
        typer.echo("getting ready…", err=True)

    from trainer.clock import Fast, Realtime
    from trainer.curriculum import load_task
    from trainer.log.schema import default_db_path, new_session_id, trainee_name

    name = trainee_name(trainee)
    session_id = new_session_id()
    log_path = db or default_db_path()
    # Absolute: the log names the recording to whoever looks for it later, from wherever.
    recording = None if no_record else (record or log_path.parent / "recordings" / f"{session_id}.rrd").absolute()
    task_file = load_task(task)
    clock = (Realtime if realtime else Fast)(task_file.task.tick_hz)
    asked = Asked(task_file, session_id, name, device, seed, log_path, recording, anatomy)
    with ExitStack() as stack:
        result = perform(stack, asked, clock)
        if as_json:
            print(json.dumps(result, indent=2, allow_nan=False))
        else:
            from trainer.cli.scores import print_result

            print_result(result, task_file.task)
        if result["dropped_frames"]:
            lacks = f"the recording lacks {result['dropped_frames']} of its pictures; the log lacks nothing"
            typer.echo(f"trainer: the machine was too busy: {lacks}", err=True)
    # A recording that could not be finished says so here, when everything else is stored and printed.


@dataclass(frozen=True)
class Asked:
    """What a session is asked to be."""

    task_file: TaskFile
    session_id: str
    trainee: str
    device: str  # a profile's name or file, or a recording
    seed: int
    log_path: Path
    recording_path: Path | None = None
    anatomy: str = ""  # the knee to practise in, where that is not the task's own


@dataclass(frozen=True)
class _Session:
    """What a session runs on, from its opening to its end."""

    asked: Asked
    tissue: Choice | None
    thread: dict[str, Any] | None  # what moves it
    knee: Anatomy | None
    scene: Scene
    profile: ProfileFile
    driver: Driver
    clock: Fast
    log: LogSink
    recording: RecordingSink | None
    sinks: tuple[Sink, ...]  # the log last: it sets its thread to work, which then has the pause between two ticks
    devices: ExitStack  # closes what was opened for the hand


def perform(
    stack: ExitStack,
    asked: Asked,
    clock: Fast,
    enough: Callable[[], bool] = lambda: False,
    observed: Callable[[Driver, Sequence[Sink]], Sink] | None = None,
) -> dict[str, Any]:
    """Run one exercise and store it; the document that ``--json`` prints. ``stack`` closes what was opened.

    ``clock`` is a fresh one at the task's rate. ``enough``, asked once in each tick, ends the session like Ctrl-C.
    ``observed`` is given the device and the sinks and makes one more sink, which may look at them.
    Whatever can be refused is refused before the session enters the log. Raises ConfigError for a task or
    device that cannot be used, LogError and RecordingError where they cannot be written.
    """
    session = _open(stack, asked, clock)
    _run(session, enough, observed)
    return _finish(session)


def _open(stack: ExitStack, asked: Asked, clock: Fast) -> _Session:
    """Everything that a session needs, in the order in which it can be refused: the log comes last."""
    from trainer.sinks.recording import RecorderProcess, RecordingSink

    recorder = None
    if asked.recording_path is not None:  # it gets ready beside all that follows
        recorder = stack.enter_context(closing(RecorderProcess()))

    from trainer.anatomy import library
    from trainer.choice import beyond, choose_tissue, overfull, thread_method
    from trainer.cli.warmup import announce, warm_up
    from trainer.clock import Realtime
    from trainer.drivers import open_driver
    from trainer.drivers.driver import LiveDriver
    from trainer.drivers.makers import stdout_kept
    from trainer.metrics.registry import check_targets
    from trainer.scene import build
    from trainer.sinks.igtlink import IgtlinkSink
    from trainer.sinks.log import LogSink

    task = asked.task_file.task
    check_targets(task)
    tissue = choose_tissue(task, asked.task_file.path)
    for doubt in filter(None, (beyond(tissue), overfull(task, tissue))):
        typer.echo(f"{asked.task_file.path}: {doubt}", err=True)
    thread = thread_method(task.scene.thread)
    knee = library.of_task(task.scene.anatomy, asked.anatomy)
    if asked.recording_path is not None:
        _make_room(asked.recording_path)
    _close_interrupted(asked.log_path)
    announce()
    scene = build(task, **({} if tissue is None else {"tolerance_mN": tissue.tolerance_mN}), anatomy=knee)
    devices = stack.enter_context(ExitStack())
    devices.enter_context(stdout_kept())  # a device's library may print whenever it opens it again
    profile, driver = open_driver(asked.device, task, scene.home, asked.seed)
    devices.enter_context(closing(driver))
    if isinstance(driver, LiveDriver) and not clock.realtime:
        clock = Realtime(task.tick_hz)  # a hand has its own pace; waiting for it is no work of a tick
    if clock.realtime:
        warm_up(task, knee)
    header = _header(asked, profile, scene.tools, tissue, knee)
    sinks: list[Sink] = []
    recording = None
    if asked.recording_path is not None:
        recording = RecordingSink(
            asked.recording_path, header, scene.layout(), task.tick_hz, realtime=clock.realtime, recorder=recorder
        )
        sinks.append(stack.enter_context(closing(recording)))
    published = profile.profile.publish
    if published is not None:
        sinks.append(stack.enter_context(closing(IgtlinkSink(published.host, published.port, scene.tools))))
    log = stack.enter_context(closing(LogSink(asked.log_path, header)))
    return _Session(asked, tissue, thread, knee, scene, profile, driver, clock, log, recording, (*sinks, log), devices)


def _run(
    session: _Session, enough: Callable[[], bool], observed: Callable[[Driver, Sequence[Sink]], Sink] | None
) -> None:
    """The exercise itself."""
    from trainer.cli.progress import Progress
    from trainer.drivers.driver import LiveDriver
    from trainer.own_core import own_core
    from trainer.session import interruptible, old_objects_left_alone, run

    driver, clock, sinks = session.driver, session.clock, session.sinks
    beside = [] if session.recording is None else [session.recording.pid]
    undisturbed = own_core(*beside) if clock.realtime else nullcontext()
    with (
        closing(Progress(session.asked.task_file.task)) as progress,
        interruptible() as interrupted,
        old_objects_left_alone(),
        undisturbed,
    ):
        told: list[Sink] = [driver] if isinstance(driver, LiveDriver) else []
        if observed is not None:
            told.append(observed(driver, sinks))
        run(session.scene, driver, [*sinks, progress, *told], clock, lambda: interrupted() or enough())


def _finish(session: _Session) -> dict[str, Any]:
    """Score and seal the session; the document about it."""
    from trainer.choice import region_method
    from trainer.metrics.registry import score
    from trainer.reporting.wording import out_of_sight

    asked, scene, log, recording = session.asked, session.scene, session.log, session.recording
    task = asked.task_file.task
    duration_s = scene.tick / task.tick_hz
    stored = log.record(scene.outcome, scene.tick, duration_s)
    metrics = score(stored, task)
    if recording is not None:
        recording.metrics(metrics)
    pace, seen = session.clock.report(), session.driver.summary()
    log.finish(scene.outcome, scene.reason, scene.tick, duration_s, pace, seen, metrics)
    session.devices.close()
    return {
        "session": asked.session_id,
        "task": asked.task_file.path,
        "anatomy": None if session.knee is None else session.knee.reference,
        "trainee": asked.trainee,
        "outcome": scene.outcome,
        "reason": scene.reason,
        "duration_s": duration_s,
        "ticks": scene.tick,
        "events": dict(Counter(event.kind for event in stored.events)),
        "metrics": [asdict(metric) for metric in metrics],
        "out_of_sight": out_of_sight(stored.events),
        "recording": None if asked.recording_path is None else str(asked.recording_path),
        "dropped_frames": 0 if recording is None else recording.dropped_frames,
        "log": str(asked.log_path),
        "methods": {
            "tissue": None if session.tissue is None else asdict(session.tissue),
            "thread": session.thread,
            "region": region_method(task.scene.anatomy),
        },
        "realtime": pace,
        "device": {"name": asked.device, "seed": asked.seed, **seen},
    }


def _header(
    asked: Asked, profile: ProfileFile, tools: tuple[str, ...], tissue: Choice | None, knee: Anatomy | None
) -> SessionHeader:
    from datetime import UTC, datetime

    from trainer.anatomy import library
    from trainer.log.record import ANATOMY, ANATOMY_SHA256, TOLERANCE, SessionHeader

    chosen = {}
    if tissue is not None:  # a float's text holds all its bits
        chosen[TOLERANCE] = repr(tissue.tolerance_mN)
    if knee is not None:
        chosen.update({ANATOMY: knee.reference, ANATOMY_SHA256: library.fingerprint(knee)})
    task_file = asked.task_file
    return SessionHeader(
        id=asked.session_id,
        trainee=asked.trainee,
        task=task_file.path,
        task_toml=task_file.text,
        task_sha256=task_file.sha256,
        device=profile.path,
        device_toml=profile.text,
        device_sha256=profile.sha256,
        seed=asked.seed,
        tick_hz=task_file.task.tick_hz,
        tools=tools,
        started_at=datetime.now(UTC).isoformat(timespec="milliseconds"),
        versions=versions() | chosen,
        recording=None if asked.recording_path is None else str(asked.recording_path),
    )


def versions() -> dict[str, str]:
    """What a session's numbers depend on, for its header."""
    import platform

    import numba
    import numpy as np
    import scipy
    from llvmlite.binding import get_host_cpu_name

    from trainer import __version__

    return {
        "trainer": __version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "numba": numba.__version__,
        "machine": f"{platform.system()} {platform.machine()} {get_host_cpu_name()}",
    }


def _make_room(recording: Path) -> None:
    """Make the folder of a recording. Raises ConfigError where there cannot be one, or a recording is there already."""
    from trainer.config import ConfigError
    from trainer.log.schema import unwritable

    if recording.exists() and not recording.is_dir():
        raise ConfigError(f"{recording}: exists already; give --record another name, or remove it")
    if why := unwritable(recording):
        raise ConfigError(f"{recording}: {why}; give --record another place, or --no-record")


def _close_interrupted(log_path: Path) -> None:
    """Make the log where there is none, and say which sessions of it were found without their end."""
    from trainer.log.recovery import recover
    from trainer.log.schema import create_log

    with create_log(log_path) as log:
        for found in recover(log):
            typer.echo(f"trainer: {found}", err=True)
