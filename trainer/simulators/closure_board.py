"""The closure sensor's board as a host hears it."""

from __future__ import annotations

from trainer.drivers.closure_line import encode
from trainer.profile import ClosureSpec

RATE_HZ = 200.0
BOOT = b"closure sensor 1, 200 Hz\r\n"


class ClosureBoard:
    """Lines of counts for the jaws of a profile, by its calibration."""

    def __init__(self, spec: ClosureSpec) -> None:
        self._spec = spec
        self._seq = 0
        self._last = {"left": 0, "right": 0}

    def line(self, time_s: float, closure: dict[str, float], stuck: bool, out_of_range: bool) -> bytes:
        """The line at ``time_s`` after power-up, of jaws that are closed by ``closure`` (0 to 1, by tool).

        Beside the signal there is the converter's last digit, which is never still.
        """
        if not stuck:
            for jaw in self._spec.jaw:
                share = 3.0 if out_of_range else closure.get(jaw.tool, 0.0)
                digit = (self._seq * 2654435761 >> 7) % 2
                self._last[jaw.tool] = max(0, round(jaw.open + share * (jaw.closed - jaw.open)) + digit)
        out = encode(self._seq, round(1e6 * time_s), self._last["left"], self._last["right"])
        self._seq += 1
        return out
