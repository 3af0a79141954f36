"""Poses for others to see: whoever listens gets whole messages, and whoever does not delays nobody."""

from __future__ import annotations

import importlib.util
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from waiting import PATIENCE_S

from trainer.geometry import Array, quaternion_from_axis_angle
from trainer.openigtlink import MessageParser, Transform
from trainer.poses import ToolPoses
from trainer.sinks.igtlink import IgtlinkSink, PublishError
from trainer.sinks.surface import TickRecord

TURN = quaternion_from_axis_angle([0.0, 0.0, 1.0], 0.5)


def no_snapshot() -> Array:
    raise AssertionError("a sink of poses asks for no frame")


def record(x: float = 0.0, valid: tuple[bool, bool] = (True, True)) -> TickRecord:
    position = np.array([[x, 0.0, 0.0], [0.0, x, 0.0]])
    quaternion = np.array([TURN, [1.0, 0.0, 0.0, 0.0]])
    return TickRecord(0, 0.0, ToolPoses(position, quaternion, np.zeros(2), np.array(valid)), (), no_snapshot)


@pytest.fixture
def sink() -> Iterator[IgtlinkSink]:
    sink = IgtlinkSink("127.0.0.1", 0, ("left", "right"))
    yield sink
    sink.close()


def listen(sink: IgtlinkSink, client: socket.socket, enough: Callable[[list[Transform]], bool]) -> list[Transform]:
    """What a client hears while ticks go by."""
    client.settimeout(0.002)
    parser, found = MessageParser(), list[Transform]()
    ends = time.monotonic() + PATIENCE_S
    while not enough(found):
        assert time.monotonic() < ends
        sink.tick(record(float(len(found))))
        try:
            found += parser.feed(client.recv(4096))
        except TimeoutError:
            continue
    assert set(parser.counts) == {"transforms"}
    return found


def test_each_client_hears_every_instrument_in_mm_of_the_world(sink: IgtlinkSink) -> None:
    """float32 keeps whole numbers; cos 0.5 and sin 0.5 are rounded by 2⁻²⁵ at most."""
    for _ in range(2):
        with socket.create_connection(("127.0.0.1", sink.port)) as client:
            found = listen(sink, client, lambda found: len(found) >= 20)
        assert [t.device for t in found[:4]] == ["LeftToWorld", "RightToWorld"] * 2
        c, s = np.cos(0.5), np.sin(0.5)
        np.testing.assert_allclose(found[0].rotation, [[c, -s, 0], [s, c, 0], [0, 0, 1]], rtol=0, atol=2**-25)
        np.testing.assert_array_equal(found[1].rotation, np.eye(3))
        assert found[0].position[0] == found[1].position[1]
        assert abs(found[0].stamp_s - time.time()) < PATIENCE_S


def test_what_is_not_seen_is_not_sent(sink: IgtlinkSink) -> None:
    with socket.create_connection(("127.0.0.1", sink.port)) as client:
        listen(sink, client, lambda found: len(found) >= 2)
        client.settimeout(PATIENCE_S)
        sink.tick(record(valid=(False, False)))
        sink.tick(record(x=7.0, valid=(False, True)))
        parser, found = MessageParser(), list[Transform]()
        while not any(t.position[1] == 7.0 for t in found):
            found += parser.feed(client.recv(4096))
    assert [t.device for t in found if 7.0 in t.position] == ["RightToWorld"]


def test_a_client_that_does_not_read_delays_nobody_and_gets_whole_messages(sink: IgtlinkSink) -> None:
    """Until the kernel takes no more for the sleeper. Another hears all the time; and what the sleeper then reads are
    whole messages."""
    with socket.socket() as sleeper, socket.socket() as client:
        sleeper.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        sleeper.connect(("127.0.0.1", sink.port))
        client.connect(("127.0.0.1", sink.port))
        listen(sink, client, lambda found: len(found) >= 2)
        listen(sink, client, lambda found: any(sink._clients.values()))
        listen(sink, client, lambda found: len(found) >= 200)
        listen(sink, sleeper, lambda found: len(found) >= 1500)  # more than the kernel had kept for it


def test_a_client_that_goes_is_forgotten(sink: IgtlinkSink) -> None:
    with socket.create_connection(("127.0.0.1", sink.port)) as client:
        listen(sink, client, lambda found: len(found) >= 2)
        assert len(sink._clients) == 1
    ends = time.monotonic() + PATIENCE_S
    while sink._clients and time.monotonic() < ends:
        sink.tick(record())
        time.sleep(0.002)
    assert not sink._clients


def test_a_port_in_use_is_one_line(sink: IgtlinkSink) -> None:
    with pytest.raises(PublishError, match=rf"^127.0.0.1:{sink.port}: Address already in use; give 'port'"):
        IgtlinkSink("127.0.0.1", sink.port, ("left",))


#: A client of pyigtl, in a process of its own: says when it has a pose of the right instrument.
PEER = """
import sys, pyigtl
client = pyigtl.OpenIGTLinkClient("127.0.0.1", int(sys.argv[1]))
message = client.wait_for_message("RightToWorld", timeout=20)
print(message.message_type, message.matrix.tolist(), flush=True)
"""


@pytest.mark.skipif(
    importlib.util.find_spec("pyigtl") is None, reason="the other implementation is not installed: pip install pyigtl"
)
def test_a_client_of_pyigtl_hears_the_poses(sink: IgtlinkSink) -> None:
    command = [sys.executable, "-c", PEER, str(sink.port)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as peer:
        while peer.poll() is None:
            sink.tick(record(2.5))
            time.sleep(0.005)
        assert peer.stdout is not None
        matrix = [[1.0, 0, 0, 0], [0, 1.0, 0, 2.5], [0, 0, 1.0, 0], [0, 0, 0, 1.0]]
        assert peer.stdout.read().replace(".0", "") == f"TRANSFORM {matrix}\n".replace(".0", "")


@pytest.mark.parametrize("host", ["nowhere.invalid", "192.0.2.1"])
def test_a_host_that_is_not_this_machine_is_named(host: str) -> None:
    """192.0.2.0/24 is kept for documentation (RFC 5737), ``.invalid`` for names that are none (RFC 6761)."""
    with pytest.raises(
        PublishError, match=rf"^{host}:0: .*; give 'host' in \[publish\] an address of this machine$"
    ) as told:
        IgtlinkSink(host, 0, ("left",))
    assert "Unknown error" not in str(told.value)
