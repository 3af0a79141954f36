"""How far the forceps are closed, read by a thread from the board that measures it."""

from __future__ import annotations

import threading
import time
from typing import Any

import numpy as np

from trainer.drivers.closure_line import Counts, LineParser
from trainer.drivers.serial_port import DeviceError, open_port, read_some
from trainer.geometry import Array
from trainer.profile import ClosureSpec, Jaw

#: Opening the port restarts the board; its first line comes after its boot loader, and no later than this, s.
FIRST_S = 5.0
STALE_S = 0.2  # a line every 5 ms is expected: forty lost in a row, assumed
RETRY_S = 0.5
#: Beyond open or closed by more than this share of the way between them a count is of no jaw. Assumed.
MARGIN = 0.2
#: A sensor that says the same for so long, while its forceps move by so much, is stuck. Its last digit is never still.
STUCK_S = 2.0
STUCK_MM = 5.0

SILENT = "closure sensor silent"
OUT_OF_RANGE = "closure sensor out of range"


class ClosureSensor:
    """Two jaws of one board. Reading begins at once; ``wait`` says whether it talks."""

    def __init__(self, spec: ClosureSpec) -> None:
        """Raises DeviceError for a port that cannot be opened."""
        self._spec = spec
        self._jaws: dict[str, _Watch] = {jaw.tool: _Watch(jaw) for jaw in spec.jaw}
        self._parser = LineParser()
        self._newest: Counts | None = None
        self._reopened = 0
        self._stop = threading.Event()
        port = open_port(spec.port, spec.baud)
        self._thread = threading.Thread(target=self._listen, args=(port,), name="closure sensor", daemon=True)
        self._thread.start()

    def wait(self) -> None:
        """Until the first line has come. Raises DeviceError where none does; closing is still to be done."""
        ends = time.monotonic() + FIRST_S
        while self._newest is None:
            if time.monotonic() > ends or not self._thread.is_alive():
                wrong = self._parser.counts["not a line"] + self._parser.counts["checksum"]
                heard = "only lines that are not a closure sensor's" if wrong else "nothing"
                raise DeviceError(f"{self._spec.port}: says {heard}; is it the board, at {self._spec.baud} baud?")
            time.sleep(0.01)

    def has(self, tool: str) -> bool:
        return tool in self._jaws

    def closure(self, tool: str, now_s: float) -> tuple[float, str]:
        """0 open to 1 closed, and "" or why it cannot be told."""
        counts = self._newest
        if counts is None or now_s - counts.arrived_s > STALE_S:
            return 0.0, SILENT
        jaw = self._jaws[tool].jaw
        share = (_raw(counts, tool) - jaw.open) / (jaw.closed - jaw.open)
        if not -MARGIN <= share <= 1.0 + MARGIN:
            return 0.0, OUT_OF_RANGE
        return min(1.0, max(0.0, share)), ""

    def moved(self, tool: str, position: Array, now_s: float) -> None:
        """The instrument's sensor is at ``position`` (3,) mm: jaws that do not notice that it moves are stuck."""
        if self._newest is not None:
            self._jaws[tool].moved(_raw(self._newest, tool), position, now_s)

    def summary(self) -> dict[str, object]:
        return {
            "port": self._spec.port,
            "lines": dict(sorted(self._parser.counts.items())),
            "reopened": self._reopened,
            "stuck_s": {tool: round(watch.stuck_s, 2) for tool, watch in self._jaws.items()},
        }

    def close(self) -> None:
        self._stop.set()
        self._thread.join()

    def _listen(self, port: Any) -> None:
        """Read until the end; a port that is gone is opened again when it is back."""
        while not self._stop.is_set():
            try:
                data = read_some(port)
            except OSError:
                port.close()
                reopened = self._reopen()
                if reopened is None:
                    return
                port = reopened
                continue
            for counts in self._parser.feed(data, time.monotonic()):
                self._newest = counts
        port.close()

    def _reopen(self) -> Any:
        while not self._stop.wait(RETRY_S):
            try:
                port = open_port(self._spec.port, self._spec.baud)
            except DeviceError:
                continue
            self._reopened += 1
            return port
        return None


def _raw(counts: Counts, tool: str) -> int:
    return counts.left if tool == "left" else counts.right


class _Watch:
    """Whether one jaw's sensor still notices anything."""

    def __init__(self, jaw: Jaw) -> None:
        self.jaw = jaw
        self.stuck_s = 0.0  # in all
        self._raw = -1
        self._since_s = 0.0
        self._seen_s = 0.0
        self._from: Array = np.zeros(3)  # where the forceps were when the count last changed, …
        self._farthest_mm = 0.0  # … and how far from there they have been: a path's length would be a tracker's noise

    def moved(self, raw: int, position: Array, now_s: float) -> None:
        if raw != self._raw or now_s - self._seen_s > STUCK_S:  # after a longer loss the account begins anew
            self._raw, self._since_s, self._from, self._farthest_mm = raw, now_s, position, 0.0
        elif now_s - self._since_s >= STUCK_S and self._farthest_mm >= STUCK_MM:
            self.stuck_s += now_s - self._seen_s
        self._farthest_mm = max(self._farthest_mm, float(np.linalg.norm(position - self._from)))
        self._seen_s = now_s
