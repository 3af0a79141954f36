"""The recording that a person looks at: a rerun file with the scene, forces, events and scores.

At most ``max_hz`` times a second a tick puts a copy of the scene into a pipe, and a process of its own writes it
(:mod:`trainer.sinks.recorder`): there rerun's Python code holds up no tick. What was measured belongs in the log, not
here: in real time a frame is dropped sooner than the simulation waits. Events are never dropped.
"""

from __future__ import annotations

import itertools
import math
import os
import pickle
import signal
import struct
import subprocess
import sys
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from trainer.events import Event, TaskDone
from trainer.geometry import Array
from trainer.log.record import Metric, SessionHeader
from trainer.log.repair import repair_command
from trainer.sinks.rrd_file import RecordingError
from trainer.sinks.surface import Layout, TickRecord

#: Bytes that may wait in the pipe: as much as Linux gives to everybody, ten or more frames.
PIPE_BYTES = 1 << 20
#: What the process answers when it is ready for the first moment.
READY = b"ready\n"
#: So many pieces are given to the pipe at once; a system allows 1024 or more.
AT_ONCE = 16


@dataclass(frozen=True)
class Beginning:
    """What the process is told first."""

    path: Path
    header: SessionHeader
    layout: Layout
    tick_hz: float


class Moment(NamedTuple):
    """What passes from a tick to the process; where a frame is due, what moves follows it."""

    tick: int
    time_s: float
    events: tuple[Event, ...]
    closure: tuple[float, ...]  # of each instrument


#: What passes through the pipe, the scores as a list, None at the end: where the pipe ends without it, the session was
#: killed. Before each stand its size pickled and that of the array behind it, bytes.
Message = Beginning | Moment | list[Metric] | None
SIZES = struct.Struct("<II")


class RecorderProcess:
    """The process that writes one recording; started ahead, it imports what it needs while a scene is built.

    Ctrl-C does not reach it. However the session's process ends, the pipe ends then, and the file is finished.
    """

    def __init__(self) -> None:
        # The same modules as here, wherever they lie.
        code = f"import sys; sys.path[:] = {sys.path!r}; from trainer.sinks.recorder import main; main()"
        self._process = subprocess.Popen(
            [sys.executable, "-c", code],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=0,
            env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
            process_group=0,  # Ctrl-C is not for it; in another session (setsid) Linux would not see that it is nice
        )
        assert self._process.stdin is not None and self._process.stdout is not None
        self._pipe, self._answers = self._process.stdin, self._process.stdout
        self._path: Path | None = None  # of the recording, once it is to begin
        self._begun = False
        self._waiting: deque[memoryview] = deque()
        self.pid = self._process.pid
        if sys.platform == "linux":
            import fcntl

            with suppress(OSError):  # a system may allow less
                fcntl.fcntl(self._pipe, fcntl.F_SETPIPE_SZ, PIPE_BYTES)

    @property
    def waiting(self) -> int:
        """How many messages, and arrays behind them, the pipe has not taken yet."""
        return len(self._waiting)

    def begin(self, beginning: Beginning, realtime: bool) -> None:
        """Wait until the file is begun; from then on, in ``realtime``, :meth:`send` does not wait for the pipe.

        Raises RecordingError.
        """
        self._path = beginning.path
        self.send(beginning)
        answer = self._answers.readline()
        if answer != READY:
            raise self._failure(answer)
        self._begun = True
        os.set_blocking(self._pipe.fileno(), not realtime)

    def send(self, message: Message, values: Array | None = None) -> None:
        """Give the pipe a message and an array (k,) behind it, which must not change any more.

        Raises RecordingError when the process has ended.
        """
        # In a real-time tick, with cold caches, to pickle an object of a class takes 50 µs, a tuple 5 (measured).
        plain = tuple(message) if isinstance(message, Moment) else message
        data = pickle.dumps(plain, pickle.HIGHEST_PROTOCOL)
        size = 0 if values is None else values.nbytes
        self._waiting.append(memoryview(SIZES.pack(len(data), size) + data))
        if values is not None and size:
            self._waiting.append(values.data.cast("B"))
        self.push()

    def push(self) -> None:
        """Give the pipe what it takes of what waits; the rest waits for the next call.

        Raises RecordingError when the process has ended.
        """
        while self._waiting:
            try:
                taken = os.writev(self._pipe.fileno(), list(itertools.islice(self._waiting, AT_ONCE)))
            except BlockingIOError:
                return
            except BrokenPipeError:
                raise self._failure() from None
            except KeyboardInterrupt:  # nobody knows how much of it was taken: what follows would be read as its rest
                self._waiting.clear()
                self._pipe.close()
                raise
            while taken:
                first = self._waiting.popleft()
                if taken < len(first):
                    self._waiting.appendleft(first[taken:])
                taken -= min(taken, len(first))

    def finish(self) -> None:
        """Wait until the file is whole. Raises RecordingError."""
        assert self._path is not None
        if self._pipe.closed:
            raise RecordingError(self._path, "it was interrupted; its end is missing")
        os.set_blocking(self._pipe.fileno(), True)
        self.send(None)
        answer = self._answers.read()
        if answer or self._process.wait():
            raise self._failure(answer)

    def close(self) -> None:
        """Wait until nothing is left of the process; one that has not begun has nothing to finish, and is ended."""
        self._pipe.close()
        if not self._begun:
            self._process.kill()
        try:
            self._process.wait()
        except KeyboardInterrupt:  # whoever waits has lost patience with it
            self._process.kill()
            self._process.wait()
            raise
        finally:
            self._answers.close()

    def _failure(self, answer: bytes = b"") -> RecordingError:
        """Why the process has ended: what it said, ``answer`` first, or what ended it."""
        assert self._path is not None
        said = (answer + self._answers.read()).decode()
        code = self._process.wait()
        known = -code in {*signal.Signals}
        by = f"by {signal.Signals(-code).name}" if known else f"with code {code}"
        ended = f"the process that writes it ended {by}"
        if self._path.exists() and self._path.stat().st_size and (repair := repair_command(self._path)):
            ended += f"; repair what is there with: {repair}"
        return RecordingError(self._path, said or ended)


class RecordingSink:
    """Writes ``path`` (.rrd). Raises RecordingError when the file cannot be made.

    A failure during the session is kept in ``error`` and raised by :meth:`close`; ``tick`` never fails.
    With ``realtime`` a frame is dropped (and counted in ``dropped_frames``) when the process is so far behind that the
    pipe is full; without it the tick waits, so that the same session gives the same recording. ``recorder`` is one that
    was started ahead, for this recording alone.
    """

    def __init__(
        self,
        path: Path,
        header: SessionHeader,
        layout: Layout,
        tick_hz: float,
        max_hz: float = 30.0,
        realtime: bool = True,
        recorder: RecorderProcess | None = None,
    ) -> None:
        self.path = Path(path)
        self.dropped_frames = 0
        self.error: RecordingError | None = None
        self._ticks_per_frame = max(1, math.ceil(tick_hz / max_hz - 1e-9))
        self._next_frame = 0
        try:
            open(self.path, "xb").close()  # not that of a session that began at the same time
        except OSError as error:
            raise RecordingError(self.path, error) from None
        self._recorder = recorder or RecorderProcess()
        self.pid = self._recorder.pid
        with ExitStack() as stack:
            stack.callback(self._recorder.close)
            self._recorder.begin(Beginning(self.path, header, layout, tick_hz), realtime)
            stack.pop_all()

    @property
    def waiting(self) -> int:
        """How many moments, and arrays behind them, the pipe has not taken yet."""
        return self._recorder.waiting

    def tick(self, record: TickRecord) -> None:
        """Take the events, and the frame when one is due; the last tick's frame is always due."""
        if self.waiting:
            self._try(self._recorder.push)
        if self.error is not None:
            return
        moving = None
        last = any(isinstance(event, TaskDone) for event in record.events)
        if record.tick >= self._next_frame or last:
            self._next_frame = record.tick + self._ticks_per_frame
            if last or not self.waiting:
                moving = record.snapshot()
            else:
                self.dropped_frames += 1
        if moving is not None or record.events:
            closure = tuple(record.poses.closure.tolist())
            moment = Moment(record.tick, record.time_s, record.events, closure)
            self._try(self._recorder.send, moment, moving)

    def metrics(self, metrics: tuple[Metric, ...]) -> None:
        """The scores, after the last tick: a scalar each, and a document with all of them."""
        self._try(self._recorder.send, list(metrics))

    def close(self) -> None:
        """Finish the file. Raises RecordingError when it is incomplete."""
        with closing(self._recorder):
            self._try(self._recorder.finish)
        if self.error is not None:
            raise self.error

    def _try(self, action: Callable[..., None], *arguments: Any) -> None:
        """Do it, unless the recording has failed already; if it fails now, keep why."""
        if self.error is None:
            try:
                action(*arguments)
            except RecordingError as error:
                self.error = error
