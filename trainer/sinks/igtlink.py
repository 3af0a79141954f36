"""Poses of a running session for others to see: a server of OpenIGTLink that 3D Slicer or PLUS connects to.

Each tick the newest pose of each instrument that is seen goes out as TRANSFORM ``LeftToWorld``, ``RightToWorld``, in mm
of the world. A tick hands its poses to a thread and goes on; whoever does not read fast enough gets fewer of them.
"""

from __future__ import annotations

import errno
import os
import socket
import threading
import time

from trainer.openigtlink import Transform, encode
from trainer.poses import ToolPoses
from trainer.sinks.surface import TickRecord

MOST_CLIENTS = 16
#: Bytes that may wait in the kernel for a client, who else would be shown the past: some 150 messages, assumed.
WAITING = 16384
FREE_PORT = "give 'port' in [publish] one that is free"


class PublishError(Exception):
    """A port that cannot be served."""


class IgtlinkSink:
    """Serves ``host:port`` from now on. Raises PublishError where it cannot."""

    def __init__(self, host: str, port: int, tools: tuple[str, ...]) -> None:
        self._names = [f"{tool.capitalize()}ToWorld" for tool in tools]
        try:
            self._listener = socket.create_server((host, port))
        except (OSError, OverflowError) as error:
            number = (isinstance(error, OSError) and error.errno) or 0  # those of a name's look-up are negative
            why = os.strerror(number) if number > 0 else str(getattr(error, "strerror", error)).partition(" (")[0]
            elsewhere = number < 0 or number == errno.EADDRNOTAVAIL
            fix = "give 'host' in [publish] an address of this machine" if elsewhere else FREE_PORT
            raise PublishError(f"{host}:{port}: {why}; {fix}") from None
        self._listener.setblocking(False)
        self.port: int = self._listener.getsockname()[1]
        self._clients: dict[socket.socket, bytes] = {}  # and what of its last message it did not take
        self._newest: tuple[ToolPoses, float] | None = None
        self._fresh = threading.Event()
        self._stop = False
        self._thread = threading.Thread(target=self._serve, name="publish", daemon=True)
        self._thread.start()

    def tick(self, record: TickRecord) -> None:
        self._newest = (record.poses, time.time())
        self._fresh.set()

    def close(self) -> None:
        self._stop = True
        self._fresh.set()
        self._thread.join()
        for client in self._clients:
            client.close()
        self._listener.close()

    def _serve(self) -> None:
        while not self._stop:
            self._fresh.wait()
            self._fresh.clear()
            data = b"" if self._newest is None else self._messages(*self._newest)
            self._welcome()
            for client in list(self._clients):
                if not self._sent(client, data):
                    client.close()
                    del self._clients[client]

    def _messages(self, poses: ToolPoses, stamp_s: float) -> bytes:
        placed = [(name, poses.world_from_tool(k)) for k, name in enumerate(self._names) if poses.valid[k]]
        return b"".join(encode(Transform(name, pose.position, pose.matrix, stamp_s)) for name, pose in placed)

    def _welcome(self) -> None:
        try:
            client, _ = self._listener.accept()
        except OSError:  # nobody waits
            return
        if len(self._clients) >= MOST_CLIENTS:
            client.close()
            return
        client.setblocking(False)
        client.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, WAITING)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._clients[client] = b""

    def _sent(self, client: socket.socket, data: bytes) -> bool:
        """Send what is left of the message before, or else this one; False where nobody is there any more."""
        try:
            if client.recv(65536) == b"":
                return False  # whatever it says is passed by
        except BlockingIOError:
            pass
        except OSError:
            return False
        data = self._clients[client] or data
        try:
            sent = client.send(data)
        except BlockingIOError:
            sent = 0
        except OSError:
            return False
        # A message that was not begun need not be sent any more.
        self._clients[client] = data[sent:] if sent or self._clients[client] else b""
        return True
