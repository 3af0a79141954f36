"""A port that cannot be opened is one line, whatever the system raises."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest
import serial

from trainer.drivers.serial_port import DeviceError, open_port

termios = pytest.importorskip("termios", reason="a terminal of POSIX")


def test_a_port_that_goes_while_it_is_opened_is_no_such_port(monkeypatch: pytest.MonkeyPatch) -> None:
    """A plug with a loose contact: the settings of a port that is gone by then cannot be set."""

    def gone(*told: object) -> None:
        raise termios.error(5, "Input/output error")

    master, slave = os.openpty()
    try:
        monkeypatch.setattr("serial.serialposix.termios.tcsetattr", gone)
        with pytest.raises(DeviceError, match="no such port; plug the device in"):
            open_port(os.ttyname(slave), 115200)
    finally:
        os.close(master)
        os.close(slave)


def test_the_bytes_of_each_opening_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """pyserial begins the file that an address names anew: a port that is opened again names another one."""
    log, asked = tmp_path / "bytes.txt", []

    def opens(url: str, do_not_open: bool) -> None:
        asked.append(url)
        Path(url.partition("file=")[2].partition("&")[0]).write_text("bytes")
        raise OSError

    monkeypatch.setattr("serial.serial_for_url", opens)
    for _ in range(3):
        with pytest.raises(DeviceError):
            open_port(f"spy://loop://?file={log}&all", 115200)
    assert asked == [f"spy://loop://?file={log}{suffix}&all" for suffix in ("", ".2", ".3")]


def test_an_address_without_a_port_is_one_line() -> None:
    with pytest.raises(DeviceError, match=r"^socket://somewhere: .*its address has no port; give host:port$"):
        open_port("socket://somewhere", 115200)


@pytest.mark.parametrize(
    ("port", "complaint"),
    [
        ("{folder}/nothing", "no such port; plug the device in, or give the profile its port"),
        ("{folder}/file/port", "no serial port; give the profile its port"),
        ("{folder}/file", "no serial port; give the profile its port"),
        ("{folder}", "no serial port; give the profile its port"),
        ("/dev/null", "no serial port; give the profile its port"),
        (
            "spy://{tty}?file={folder}/no/log",
            "its log of bytes cannot be written: {folder}/no/log: No such file",
        ),
        ("spy:///dev/nothing?file={folder}/log.txt", "no such port; plug the device in"),
        ("socket://nowhere.invalid:1", "no such host; correct the profile"),
        ("socket://127.0.0.1:{unused}", "nobody answers there; start what serves the port, or correct the profile"),
        ("rfc2217://127.0.0.1:{unused}", "nobody answers there; start what serves the port, or correct the profile"),
    ],
)
def test_what_is_wrong_with_a_port_is_said_in_our_words(tmp_path: Path, port: str, complaint: str) -> None:
    """Its address, what is wrong, what to do; never the library's words nor the system's number."""
    (tmp_path / "file").touch()
    master, slave = os.openpty()
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        names = {"folder": tmp_path, "tty": os.ttyname(slave), "unused": held.getsockname()[1]}
        with pytest.raises(DeviceError) as told:
            open_port(port.format(**names), 9600)
    os.close(master)
    os.close(slave)
    assert str(told.value).startswith(f"{port.format(**names)}: {complaint.format(**names)}")
    assert "Errno" not in str(told.value)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]  # no empty log is left behind
    assert "\n" not in str(told.value)


def test_a_port_of_somebody_else_and_one_in_use_say_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever runs the tests may be allowed everything: the system's answer is given for it."""
    master, slave = os.openpty()
    port = os.ttyname(slave)
    with serial.Serial(port, exclusive=True), pytest.raises(DeviceError, match="in use by another program"):
        open_port(port, 9600)

    def refused(*told: object) -> None:
        raise PermissionError(13, "Permission denied")

    with monkeypatch.context() as patched:
        patched.setattr("serial.serialposix.os.open", refused)
        with pytest.raises(DeviceError, match="not allowed; on Linux join the group 'dialout' and log in again"):
            open_port(port, 9600)
    os.close(master)
    os.close(slave)
