"""The process that writes a recording: it imports rerun, and it alone.

It is started by :class:`trainer.sinks.recording.RecorderProcess`, reads what the session tells it from its standard
input (a Beginning, then Moments and scores, then None) and answers on its standard output: a line when it
is ready, and why if it fails. Where its input ends without the None, the session's process was killed; the recording is
finished then as well.

World coordinates are mm with +z up, on the timelines ``tick`` and ``sim_time``. Vertices are rounded for the eye: what
was measured belongs in the log. The trainee's name is not in the file.
"""

from __future__ import annotations

import dataclasses
import datetime
import os
import pickle
import signal
import sys
import time
import tomllib
from collections.abc import Iterator
from contextlib import closing, suppress
from io import FileIO
from select import select

import numpy as np
import rerun as rr

from trainer.events import (
    Break,
    Drop,
    Event,
    Grasp,
    Overforce,
    Release,
    Slip,
    StepDone,
    TaskDone,
    TaskStarted,
    Tear,
    TickOverrun,
    TrackingLost,
)
from trainer.geometry import Array
from trainer.log.record import Metric
from trainer.sinks.blueprint import blueprint
from trainer.sinks.normals import vertex_normals
from trainer.sinks.recording import READY, SIZES, Beginning, Message, Moment
from trainer.sinks.rrd_file import RrdFile
from trainer.sinks.surface import Frame

#: The session's threads come first where they share a core with this process: ten to one. Assumed.
NICER = 10
#: Step to which vertices are rounded, mm (0.24 µm). A power of two clears the low bits of a float32, which is
#: what lets LZ4 shrink them; the step is a twentieth of a pixel where 5 mm fill 1000 pixels.
VERTEX_STEP_MM = 2.0**-12
#: Step to which normals are rounded: 0.2 degrees, invisible in shading.
NORMAL_STEP = 2.0**-8
#: Where this process is killed, too, the pictures of at most so much simulated time are lost, s; in the beginning of
#: half the session. Of each flush rerun keeps some 60 kB for the file's footer: one every second adds 4 MB a minute
#: (measured).
FLUSH_S = 5.0

#: So often it looks whether the session has told it something more, s; assumed. The pipe holds half a second.
IDLE_S = 0.01

STEEL = (176, 184, 192, 255)
NEEDLE = (226, 230, 235, 255)
THREAD = (58, 130, 246, 255)
LEVELS: dict[type[Event], str] = {
    Break: "ERROR",
    Tear: "ERROR",
    Slip: "WARN",
    Drop: "WARN",
    Overforce: "WARN",
    TrackingLost: "WARN",
    TickOverrun: "WARN",
}


def main() -> None:
    """Write one recording, from the standard input."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the session, whose end comes through the pipe
    answers = os.dup(sys.stdout.fileno())
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what a library prints is no answer
    code = 0
    with suppress(BrokenPipeError):  # a session that was killed hears no answer
        try:
            _record(_messages(FileIO(sys.stdin.fileno())), answers)
        except Exception as error:  # of whatever kind: the session goes on without its recording
            code = 1
            os.write(answers, (getattr(error, "reason", "") or str(error) or type(error).__name__).encode())
    os._exit(code)  # all is written and closed; to take the modules apart takes another half second


def _record(messages: Iterator[tuple[Message, Array]], answers: int) -> None:
    os.nice(NICER)
    _normals(np.zeros((1, 3)), np.zeros((1, 3), dtype=np.int32))  # to load the kernel takes half a second
    beginning, _ = next(messages, (None, None))
    if not isinstance(beginning, Beginning):  # the session was refused
        return
    with closing(Recorder(beginning)) as recorder:
        os.write(answers, READY)
        for message, values in messages:
            recorder.write(message, values)


def _messages(source: FileIO) -> Iterator[tuple[Message, Array]]:
    """Each with the array behind it, until the session says that it is over, or the pipe ends."""
    with suppress(EOFError):
        while True:
            # Who waits in a read is woken by the write: in a tick of the session that takes 30 µs (measured).
            while not select([source], [], [], 0.0)[0]:
                time.sleep(IDLE_S)
            size, behind = SIZES.unpack(_read(source, SIZES.size))
            message, values = pickle.loads(_read(source, size)), np.frombuffer(_read(source, behind))
            if message is None:
                return
            yield Moment(*message) if isinstance(message, tuple) else message, values


def _read(source: FileIO, size: int) -> bytearray:
    """Raises EOFError where the pipe ends before."""
    data = bytearray(size)
    rest = memoryview(data)
    while rest:
        if not (count := source.readinto(rest)):
            raise EOFError
        rest = rest[count:]
    return data


class Recorder:
    """Writes one recording. Raises RecordingError when its file cannot be made or, later, when it is incomplete."""

    def __init__(self, beginning: Beginning) -> None:
        self._header = header = beginning.header
        self._layout = layout = beginning.layout
        self._tick_hz = beginning.tick_hz
        self._draw = layout.pictures is not None
        self._next_flush = 0
        self._last = (0, 0.0)
        self._steps = [str(step["name"]) for step in tomllib.loads(header.task_toml).get("step", [])]
        # Chunks end where the session's own clock says (see _write), not the machine's: the same session gives
        # the same chunks, and `rerun rrd compare` finds two recordings equal.
        self._stream = rr.RecordingStream(
            "trainer",
            recording_id=header.id,
            send_properties=True,
            batcher_config=rr.ChunkBatcherConfig(flush_tick=datetime.timedelta(days=1)),
        )
        self._stream.set_log_time_enabled(False)
        self._file = RrdFile(beginning.path, self._stream, blueprint(layout))
        self._log_header()
        self._log_layout()

    def write(self, message: Message, values: Array) -> None:
        """One moment with what moves in it, or the scores after the last one."""
        match message:
            case Moment():
                self._write(message, values)
            case list():
                self._log_metrics(message)
        if self._file.error is not None:
            raise self._file.error

    def close(self) -> None:
        """Finish the file."""
        self._stream.disconnect()
        self._file.close()
        if self._file.error is not None:
            raise self._file.error

    def _write(self, moment: Moment, values: Array) -> None:
        if moment.tick >= self._next_flush:
            self._stream.flush()
            self._next_flush = moment.tick + round(self._tick_hz * min(FLUSH_S, max(1.0, moment.time_s)))
        for event in moment.events:
            self._set_time(event.tick, event.time_s)
            self._log_event(event)
            # They cost as much as many frames: one drawing for each step of the task, one at the end.
            self._draw |= isinstance(event, StepDone | TaskDone)
        self._last = (moment.tick, moment.time_s)
        if len(values):
            frame = self._layout.frame(values)
            self._set_time(*self._last)
            self._log_frame(frame)
            if self._draw and self._layout.pictures is not None:
                self._draw = False
                for name, picture in self._layout.pictures(frame).items():
                    self._stream.log(f"pictures/{name}", rr.Image(picture))
            for tool, closure in zip(self._header.tools, moment.closure, strict=True):
                self._stream.log(f"closure/{tool}", rr.Scalars(closure))

    def _set_time(self, tick: int, time_s: float) -> None:
        self._stream.set_time("tick", sequence=tick)
        self._stream.set_time("sim_time", duration=time_s)

    def _log_header(self) -> None:
        header = self._header
        started = datetime.datetime.fromisoformat(header.started_at)
        self._stream.send_recording_name(f"{header.task} {header.started_at}")
        self._stream.send_recording_start_time_nanos(int(started.timestamp()) * 1_000_000_000)
        self._stream.send_property(
            "session",
            rr.AnyValues(
                id=header.id,
                task=header.task,
                task_sha256=header.task_sha256,
                device=header.device,
                device_sha256=header.device_sha256,
                seed=header.seed,
                tick_hz=header.tick_hz,
                units="mm, s, mN",
                versions=[f"{name} {version}" for name, version in sorted(header.versions.items())],
            ),
        )

    def _log_layout(self) -> None:
        """All that does not change. A static vertex position would shadow every later one: none here."""
        log = self._stream.log
        layout = self._layout
        log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for surface in layout.surfaces:
            if surface.fixed is None:
                mesh = rr.Mesh3D.from_fields(triangle_indices=surface.triangles, albedo_factor=surface.rgba)
            else:
                mesh = rr.Mesh3D(
                    vertex_positions=surface.fixed,
                    triangle_indices=surface.triangles,
                    vertex_normals=_normals(surface.fixed, surface.triangles),
                    albedo_factor=surface.rgba,
                )
            log(f"world/{surface.name}", mesh, static=True)
        for part in layout.parts:
            mesh = rr.Mesh3D(
                vertex_positions=part.vertices,
                triangle_indices=part.triangles,
                vertex_normals=_normals(part.vertices, part.triangles),
                albedo_factor=STEEL,
            )
            log(f"world/instruments/{part.name}", mesh, static=True)
        for cloud in layout.clouds:
            if cloud.fixed is not None:
                balls = rr.Points3D(cloud.fixed, radii=cloud.radius_mm, colors=cloud.rgba)
            else:
                balls = rr.Points3D.from_fields(radii=cloud.radius_mm, colors=cloud.rgba)
            log(f"world/{cloud.name}", balls, static=True)
        if layout.needle is not None:
            needle = rr.LineStrips3D([layout.needle], radii=layout.needle_radius_mm, colors=NEEDLE)
            log("world/needle", needle, static=True)
        thread = rr.LineStrips3D.from_fields(radii=layout.thread_radius_mm, colors=THREAD)
        log("world/thread", thread, static=True)
        log("force/tissue", rr.SeriesLines(names="instruments on tissue", colors=(240, 120, 110)), static=True)
        log("force/thread", rr.SeriesLines(names="tension of the thread", colors=THREAD), static=True)
        for tool in self._header.tools:
            log(f"closure/{tool}", rr.SeriesLines(names=tool), static=True)

    def _log_frame(self, frame: Frame) -> None:
        log = self._stream.log
        surfaces = [surface for surface in self._layout.surfaces if surface.fixed is None]
        for surface, vertices in zip(surfaces, frame.vertices, strict=True):
            mesh = rr.Mesh3D.from_fields(
                vertex_positions=_rounded(vertices, VERTEX_STEP_MM),
                vertex_normals=_rounded(_normals(vertices, surface.triangles), NORMAL_STEP),
            )
            log(f"world/{surface.name}", mesh)
        moving = [cloud for cloud in self._layout.clouds if cloud.fixed is None]
        for cloud, points in zip(moving, frame.clouds, strict=True):
            log(f"world/{cloud.name}", rr.Points3D.from_fields(positions=_rounded(points, VERTEX_STEP_MM)))
        for k, part in enumerate(self._layout.parts):
            log(f"world/instruments/{part.name}", _transform(frame.part_position[k], frame.part_quaternion[k]))
        if frame.needle_position is not None and frame.needle_quaternion is not None:
            log("world/needle", _transform(frame.needle_position, frame.needle_quaternion))
        pieces = [_rounded(piece, VERTEX_STEP_MM) for piece in frame.thread]
        log("world/thread", rr.LineStrips3D.from_fields(strips=pieces))
        log("force/tissue", rr.Scalars(frame.force_mN))
        log("force/thread", rr.Scalars(frame.tension_mN))

    def _log_event(self, event: Event) -> None:
        log = self._stream.log
        log("events", rr.TextLog(_sentence(event), level=LEVELS.get(type(event), "INFO")))
        match event:
            case TaskStarted() if self._steps:
                log("state/step", rr.StateChange(state=self._steps[0]))
            case StepDone(index=index) if index + 1 < len(self._steps):
                log("state/step", rr.StateChange(state=self._steps[index + 1]))
            case TaskDone(outcome=outcome):
                log("state/step", rr.StateChange(state=outcome))
            case Grasp(tool=tool, target=target):
                log(f"state/{tool}", rr.StateChange(state=target))
            case Release(tool=tool) | Slip(tool=tool):
                log(f"state/{tool}", rr.StateChange(state=[]))  # a gap in the lane; `rrd verify` refuses null

    def _log_metrics(self, metrics: list[Metric]) -> None:
        self._set_time(*self._last)
        for metric in metrics:
            if metric.value is not None:
                self._stream.log(f"metrics/{metric.name}", rr.Scalars(metric.value))
        document = rr.TextDocument(_scores(metrics), media_type=rr.MediaType.MARKDOWN)
        self._stream.log("scores", document, static=True)


def _normals(vertices: Array, triangles: np.ndarray) -> Array:
    normals = np.zeros_like(vertices)
    vertex_normals(vertices, triangles, normals)
    return normals


def _rounded(values: Array, step: float) -> np.ndarray:
    """``values`` as float32 multiples of ``step``, a power of two (exact below 2^24 steps: 4 m for vertices)."""
    return np.asarray(np.rint(values / step) * step, dtype=np.float32)


def _transform(position: Array, quaternion: Array) -> rr.Transform3D:
    return rr.Transform3D.from_fields(translation=position, quaternion=rr.Quaternion(xyzw=np.roll(quaternion, -1)))


def _sentence(event: Event) -> str:
    """The event in one line: kind, tool, then its own fields."""
    shared = {field.name for field in dataclasses.fields(Event)}
    own = [f.name for f in dataclasses.fields(event) if f.name not in shared]
    values = {name: _short(getattr(event, name)) for name in own}
    fields = [f"{name}={value}" for name, value in values.items() if value]
    return " ".join([event.kind, *([event.tool] if event.tool else []), *fields])


def _short(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, tuple):
        return f"({', '.join(map(_short, value))})"
    return str(value)


def _scores(metrics: list[Metric]) -> str:
    """A Markdown table of the metrics with their target bands and sources."""
    rows = ["| measure | value | unit | target | source |", "|---|---:|---|---|---|"]
    for m in metrics:
        value = "–" if m.value is None else f"{m.value:.3g}"
        bounds = ["" if b is None else f"{b:g}" for b in (m.target_low, m.target_high)]
        rows.append(f"| {m.name} | {value} | {m.unit} | {' … '.join(bounds) if any(bounds) else ''} | {m.source} |")
    return "\n".join(rows)
