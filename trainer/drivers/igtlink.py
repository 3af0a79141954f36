"""Poses from a server of OpenIGTLink: PLUS, 3D Slicer, or this program."""

from __future__ import annotations

import socket
import time

import numpy as np

from trainer.drivers.connected import flawed
from trainer.drivers.live import Reading
from trainer.drivers.plausible import FARTHEST_MM, is_rotation
from trainer.drivers.serial_port import DeviceError
from trainer.geometry import quaternion_from_matrix
from trainer.openigtlink import MessageParser, Transform
from trainer.profile import OpenigtlinkSpec

#: A server that does not take the connection within this time is not there, s.
CONNECT_S = 2.0
READ_S = 0.05
#: A server whose machine has gone says no farewell; it is asked after so many s of silence, so often.
KEEPALIVE = {"TCP_KEEPIDLE": 1, "TCP_KEEPINTVL": 1, "TCP_KEEPCNT": 3}


class Server:
    """A connection to the server of a profile."""

    def __init__(self, spec: OpenigtlinkSpec) -> None:
        """Raises DeviceError."""
        self._where = f"{spec.host}:{spec.port}"
        self._names = {device.name for device in spec.device}
        self._parser = MessageParser()
        try:
            self._socket = socket.create_connection((spec.host, spec.port), CONNECT_S)
            if self._socket.getsockname() == self._socket.getpeername():
                self._socket.close()  # TCP connects a port of this machine that nobody serves to itself now and then
                raise ConnectionRefusedError("Connection refused")
        except (OSError, UnicodeError) as error:
            why = getattr(error, "strerror", None) or error
            raise DeviceError(f"{self._where}: {why}; start the OpenIGTLink server, or correct the profile") from None
        self._socket.settimeout(READ_S)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for option, value in KEEPALIVE.items():
            if hasattr(socket, option):  # not everywhere under these names
                self._socket.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)

    def read(self) -> list[Reading]:
        try:
            data = self._socket.recv(65536)
        except TimeoutError:
            return []
        except OSError:
            data = b""
        if not data:
            raise DeviceError(f"{self._where}: the server is gone")
        found = self._parser.feed(data)
        if self._parser.broken:
            raise DeviceError(f"{self._where}: {self._parser.broken}; is it another service's port?")
        now = time.monotonic()
        return [_reading(transform, now) for transform in found if transform.device in self._names]

    def close(self) -> None:
        self._socket.close()


def _reading(transform: Transform, now_s: float) -> Reading:
    position, rotation = transform.position, transform.rotation
    if not (np.isfinite(position).all() and np.abs(position).max() <= FARTHEST_MM):
        return flawed(transform.device, now_s, "its position is none")
    if not (np.isfinite(rotation).all() and is_rotation(rotation[None])[0]):
        return flawed(transform.device, now_s, "its matrix is no rotation")
    return Reading(transform.device, now_s, position, quaternion_from_matrix(rotation))
