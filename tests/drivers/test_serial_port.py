"""A port that cannot be opened is one line, whatever the system raises."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

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
