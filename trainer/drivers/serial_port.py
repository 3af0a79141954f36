"""Serial ports of devices, by any address that pyserial knows (``/dev/ttyUSB0``, ``socket://``, ``spy://`` …)."""

from __future__ import annotations

import errno
import re
import socket
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import serial

#: What opening a port raises: a port that goes while it is opened has the terminal's own error, no OSError.
if sys.platform == "win32":
    REFUSALS: tuple[type[Exception], ...] = (OSError, ValueError)
else:
    import termios

    REFUSALS = (OSError, ValueError, termios.error)

#: A read that gets nothing returns after this long, so that a thread sees soon that it is to end.
READ_S = 0.05
WRITE_S = 1.0


class DeviceError(Exception):
    """A device that does not do what it should; the text is one line that names its port."""


def open_port(url: str, baud: int) -> Any:
    """The port, 8N1 without flow control, for this program alone. Raises DeviceError.

    RTS low lets a tracker run and high holds it in reset, DTR low stops its output: both are set before the port is
    opened, since pyserial would raise both. A pseudo-terminal has neither line; setting them before is no error there.
    """
    port: Any = None
    try:
        if url.startswith(("socket://", "rfc2217://")) and urlsplit(url).port is None:
            raise ValueError("its address has no port; give host:port")
        port = serial.serial_for_url(_fresh_log(url), do_not_open=True)
        port.baudrate = baud
        port.timeout, port.write_timeout = READ_S, WRITE_S
        port.rts, port.dtr = False, True
        if isinstance(port, serial.Serial) and hasattr(port, "exclusive"):
            port.exclusive = True
        port.open()
    except REFUSALS as error:
        _forget_log(port)
        raise DeviceError(f"{url}: {_why(url, error)}") from None
    _hand_over_at_once(port)
    return port


def _fresh_log(url: str) -> str:
    """The address, its log of bytes (``spy://…?file=``) under a name of its own: pyserial would begin it anew."""
    found = re.fullmatch(r"(spy://.*[?&]file=)([^&]+)(.*)", url)
    if found is None:
        return url
    log, count = found[2], 1
    while Path(log).is_file():
        count += 1
        log = f"{found[2]}.{count}"
    return f"{found[1]}{log}{found[3]}"


def _forget_log(port: Any) -> None:
    """A port that could not be opened leaves an open and empty log of bytes behind, one each time it is tried."""
    log = getattr(getattr(port, "formatter", None), "output", None)
    if log is not None and log is not sys.stderr:
        log.close()
        if Path(log.name).is_file():
            Path(log.name).unlink()


def _hand_over_at_once(port: Any) -> None:
    """USB adapters keep bytes for up to 16 ms, 1 ms where Linux asks them to; other ports have no such setting."""
    ask = getattr(port, "set_low_latency_mode", None)
    if ask is not None:
        with suppress(OSError, ValueError, NotImplementedError):
            ask(True)


def _why(url: str, error: Exception) -> str:
    """What is wrong with a port, and what to do: pyserial puts words of its own around what the system said."""
    said = error.__context__ or error
    number = said.args[0] if said.args else None
    if "exclusively lock" in str(error) or number in (errno.EBUSY, errno.EAGAIN):
        return "in use by another program; end that one first"
    if isinstance(said, OSError) and url.startswith("spy://") and said.filename not in (None, _device(url)):
        return f"its log of bytes cannot be written: {said.filename}: {said.strerror}"
    if isinstance(said, (ConnectionRefusedError, TimeoutError)):
        return "nobody answers there; start what serves the port, or correct the profile"
    if isinstance(said, socket.gaierror):
        return "no such host; correct the profile"
    if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO, errno.EIO):
        return "no such port; plug the device in, or give the profile its port"
    if number in (errno.EACCES, errno.EPERM):
        return "not allowed; on Linux join the group 'dialout' and log in again"
    if number in (errno.EISDIR, errno.ENOTDIR, errno.ENOTTY, errno.EINVAL):
        return "no serial port; give the profile its port"
    if str(error).startswith("Remote"):
        return "what answers there does not speak RFC 2217; give socket:// to a plain connection"
    why = said.strerror if isinstance(said, OSError) and said.strerror else str(said)
    return f"cannot be opened: {' '.join(why.split())}"


def _device(url: str) -> str:
    """The port inside of an address that writes a log."""
    return url.removeprefix("spy://").partition("?")[0]


def set_reset(port: Any, held: bool) -> None:
    """RTS, where the line has one."""
    try:
        port.rts = held
    except OSError as error:
        if error.errno != errno.ENOTTY:
            raise


def read_some(port: Any) -> bytes:
    """What has come, at least one byte unless ``READ_S`` pass without. Raises OSError where the port is gone.

    First the wait, then all that came with the byte that ended it: one turn of the interpreter's lock for a record.
    """
    first = bytes(port.read(1))
    waiting = port.in_waiting if first else 0
    return first + bytes(port.read(waiting)) if waiting else first
