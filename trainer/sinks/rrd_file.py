"""An .rrd file that survives a full disk.

When a write fails, rerun 0.41's own file sink says so on stderr and its thread ends; from then on
``disconnect`` and even the exit of the interpreter wait for ever (measured with RLIMIT_FSIZE). So rerun
writes into a pipe, which does not fail, and a thread copies the bytes to the file: a failure is an OSError in
our hands, what was written so far stays, and the rest is read and thrown away.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

_BYTES_AT_ONCE = 1 << 16


class RecordingError(OSError):
    """The recording cannot be written; the text is one line. The session itself is not affected."""

    def __init__(self, path: Path, reason: Exception | str) -> None:
        self.reason = str(getattr(reason, "strerror", None) or reason) or type(reason).__name__
        super().__init__(f"{path}: cannot write the recording: {self.reason}")


class RrdFile:
    """The file at ``path`` that all messages of ``stream`` go to; ``error`` is set as soon as a write fails.

    Raises RecordingError when the file cannot be made. Needs /dev/fd (Linux, macOS).
    """

    def __init__(self, path: Path, stream: rr.RecordingStream, blueprint: rrb.Blueprint) -> None:
        self.path = path
        self.error: RecordingError | None = None
        try:
            self._file = open(path, "wb", buffering=0)  # noqa: SIM115 - the thread closes it
        except OSError as error:
            raise RecordingError(path, error) from None
        self._source, target = os.pipe()
        self._thread = threading.Thread(target=self._copy, name="rrd-file", daemon=True)
        self._thread.start()
        stream.save(f"/dev/fd/{target}", default_blueprint=blueprint)
        os.close(target)  # rerun opened its own: where that one ends, the file ends

    def close(self) -> None:
        """Wait for the last byte; the stream must have been disconnected before."""
        self._thread.join()

    def _copy(self) -> None:
        while data := os.read(self._source, _BYTES_AT_ONCE):
            if self.error is None:
                self._keep_error(self._write, data)
        os.close(self._source)
        self._keep_error(self._file.close)

    def _keep_error(self, action: Callable[..., None], *arguments: bytes) -> None:
        try:
            action(*arguments)
        except OSError as error:
            self.error = self.error or RecordingError(self.path, error)

    def _write(self, data: bytes) -> None:
        rest = memoryview(data)
        while rest:
            rest = rest[self._file.write(rest) :]
