"""A port that cannot be opened is one line, whatever the system raises."""

from __future__ import annotations

import os

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
