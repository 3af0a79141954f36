"""Instruments moved over OpenIGTLink on loopback: by this program's own server, by pyigtl's, and by none."""

from __future__ import annotations

import importlib.util
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from live_polling import HOME, TICK_HZ, TOOLS, Polling, all_seen, none_seen
from waiting import PATIENCE_S

from trainer.config import ConfigError
from trainer.drivers import connected, in_hand
from trainer.drivers.connected import Connected
from trainer.drivers.igtlink import Server
from trainer.drivers.live import LivePoses
from trainer.drivers.serial_port import DeviceError
from trainer.geometry import quaternion_from_axis_angle
from trainer.openigtlink import Transform, encode
from trainer.poses import ToolPoses
from trainer.profile import OpenigtlinkSpec, Tracked
from trainer.sinks.igtlink import IgtlinkSink
from trainer.sinks.surface import TickRecord

DEVICES = (Tracked(name="LeftToWorld", tool="left"), Tracked(name="RightToWorld", tool="right", closure=0.25))
POSES = ToolPoses(
    np.array([[0.5, 0.25, -3.0], [10.0, -20.0, 30.0]]),
    np.array([[1.0, 0.0, 0.0, 0.0], quaternion_from_axis_angle([0.0, 0.6, 0.8], 1.0)]),
    np.zeros(2),
    np.ones(2, dtype=bool),
)
IDENTITY = Transform("LeftToWorld", np.zeros(3), np.eye(3), 0.0)


def no_snapshot() -> None:
    raise AssertionError("a sink of poses asks for no frame")


def record(poses: ToolPoses = POSES) -> TickRecord:
    return TickRecord(0, 0.0, poses, (), no_snapshot)  # type: ignore[arg-type]


@contextmanager
def publishing(port: int = 0, poses: ToolPoses = POSES) -> Iterator[int]:
    """A session that publishes the same poses at 200 Hz; its port."""
    sink, ended = IgtlinkSink("127.0.0.1", port, TOOLS), threading.Event()

    def ticks() -> None:
        while not ended.wait(0.005):
            sink.tick(record(poses))

    thread = threading.Thread(target=ticks)
    thread.start()
    try:
        yield sink.port
    finally:
        ended.set()
        thread.join()
        sink.close()


def opened(port: int, spec: OpenigtlinkSpec | None = None) -> LivePoses:
    spec = spec or OpenigtlinkSpec(device=DEVICES, port=port)
    source = partial(Connected, "openigtlink", partial(Server, spec))
    return LivePoses(source, spec, spec.device, None, TOOLS, TICK_HZ, HOME)


def test_published_poses_are_the_poses_that_are_read(monkeypatch: pytest.MonkeyPatch) -> None:
    """float32 rounds 30 mm by 1e-6 mm (half a step of 2⁻¹⁹), and each of the rotation's entries by 3e-8; a quaternion
    is no farther off than a few of those. However late a busy machine brings them, none is lost."""
    monkeypatch.setattr(in_hand, "FIRST_S", PATIENCE_S)
    monkeypatch.setattr(Connected, "stale_s", PATIENCE_S)
    with publishing() as port:
        polling = Polling(driver := opened(port))
        polling.until(lambda poses: np.array_equal(poses.position[0], POSES.position[0]))
        seen = polling.until(lambda poses: bool(abs(poses.position[1, 0] - 10.0) < 1.0))
        driver.close()
    np.testing.assert_allclose(seen.position, POSES.position, rtol=0, atol=1e-6)
    np.testing.assert_allclose(seen.quaternion, POSES.quaternion, rtol=0, atol=5e-7)
    assert seen.closure.tolist() == [1.0, 0.25]
    summary = driver.summary()
    assert summary["losses"] == 0
    assert set(summary["readings"]) == {"good"}  # type: ignore[call-overload]
    assert summary["latency_ms"]["poses"] > 0  # type: ignore[index]


def test_a_profile_s_scale_anchor_and_tip_are_applied() -> None:
    """At home at first, whatever the tracker says; the tip is 10 mm along x of a sensor turned by 90° about z."""
    turned = Transform("LeftToWorld", np.array([5.0, 0.0, 0.0]), np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), 0.0)
    spec = OpenigtlinkSpec(
        device=(Tracked(name="LeftToWorld", tool="left", position_mm=(10.0, 0.0, 0.0)),), scale=0.1, anchor="home"
    )
    with talking(encode(IDENTITY)) as (port, say):
        driver = LivePoses(
            partial(Connected, "openigtlink", partial(Server, replace(spec, port=port))),
            spec,
            spec.device,
            None,
            TOOLS,
            TICK_HZ,
            HOME,
        )
        polling = Polling(driver)
        polling.until(lambda poses: driver.summary()["latency_ms"]["poses"] >= 1)  # type: ignore[index]
        np.testing.assert_allclose(polling.last.position[0], HOME.position[0], rtol=0, atol=1e-12)
        say[0] = encode(turned)
        home = HOME.position[0]
        polling.until(lambda poses: not np.allclose(poses.position[0], home, atol=1e-9))
        driver.close()
    # From (10, 0, 0) to (0.5, 10, 0): 0.1 · 5 mm, and the tip at 10 mm along the turned x. Sums of a few doubles.
    np.testing.assert_allclose(polling.last.position[0], home + np.array([0.5 - 10.0, 10.0, 0.0]), rtol=0, atol=1e-9)


@contextmanager
def talking(data: bytes) -> Iterator[tuple[int, list[bytes]]]:
    """A server that says the same a hundred times a second to whoever comes; what it says can be changed."""
    say, ended = [data], threading.Event()
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.settimeout(0.01)

        def serve() -> None:
            clients: list[socket.socket] = []
            while not ended.wait(0.01):
                with suppress(TimeoutError):
                    clients.append(listener.accept()[0])
                for client in list(clients):
                    try:
                        client.sendall(say[0])
                    except OSError:
                        client.close()
                        clients.remove(client)
            for client in clients:
                client.close()

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield listener.getsockname()[1], say
        finally:
            ended.set()
            thread.join()


def test_a_server_that_goes_and_returns_costs_no_session(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connected, "RETRY_S", 2.0)  # in which the first reason is heard
    with publishing() as port:
        polling = Polling(driver := opened(port))
        polling.until(lambda poses: not np.array_equal(poses.position, HOME.position))
    polling.until(none_seen)
    polling.until(lambda poses: "start the OpenIGTLink server" in polling.reasons())
    assert "the server is gone" in polling.reasons()
    with publishing(port):
        polling.until(all_seen)
        driver.close()
    assert driver.summary()["reconnects"] == 1


def test_an_instrument_that_is_not_published_is_lost_alone_and_says_so() -> None:
    one = ToolPoses(POSES.position, POSES.quaternion, POSES.closure, np.array([True, False]))
    with publishing(poses=one) as port:
        polling = Polling(driver := opened(port))
        polling.until(lambda poses: poses.valid.tolist() == [True, False])
        driver.close()
    reasons = {loss["reason"] for loss in polling.summary()["lost"] if loss["tool"] == "right"}
    assert reasons == {"nothing comes of 'RightToWorld'"}


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        (Transform("LeftToWorld", np.zeros(3), 2.0 * np.eye(3), 0.0), "its matrix is no rotation"),
        (Transform("LeftToWorld", np.zeros(3), -np.eye(3), 0.0), "its matrix is no rotation"),
        (Transform("LeftToWorld", np.zeros(3), np.full((3, 3), np.nan), 0.0), "its matrix is no rotation"),
        (Transform("LeftToWorld", np.array([np.inf, 0, 0]), np.eye(3), 0.0), "its position is none"),
    ],
)
def test_numbers_that_are_no_pose_move_nothing(wrong: Transform, reason: str) -> None:
    with talking(encode(wrong)) as (port, _):
        polling = Polling(driver := opened(port))
        polling.until(lambda poses: none_seen(poses) and reason in polling.reasons())
        driver.close()
    np.testing.assert_array_equal(polling.last.position, HOME.position)


def test_another_service_on_the_port_is_told() -> None:
    with talking(b"SSH-2.0-nothing of the kind\r\n") as (port, _):
        polling = Polling(driver := opened(port))
        polling.until(lambda poses: "what comes is not OpenIGTLink; is it another service's port?" in polling.reasons())
        driver.close()


def test_no_server_is_one_line() -> None:
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        port = held.getsockname()[1]
        with pytest.raises(DeviceError, match=f"^127.0.0.1:{port}: Connection refused; start the OpenIGTLink server"):
            opened(port)
    with pytest.raises(DeviceError, match="start the OpenIGTLink server"):
        Server(OpenigtlinkSpec(device=DEVICES, host="no such host.invalid"))


def test_a_device_that_moves_nothing_of_the_task_is_refused() -> None:
    spec = OpenigtlinkSpec(device=DEVICES)
    with pytest.raises(ConfigError, match="the device moves left, right; the task has third"):
        LivePoses(
            partial(Connected, "openigtlink", partial(Server, spec)), spec, spec.device, None, ("third",), TICK_HZ, HOME
        )


def test_a_poll_does_not_wait_for_a_silent_server() -> None:
    """Ticks go by at their own pace, twenty of 5 ms, though nothing ever comes; the thread ends with the session."""
    with talking(b"") as (port, _):
        polling = Polling(driver := opened(port))
        polling.until(lambda poses: polling.ticks >= 20)
        driver.close()
    assert "openigtlink" not in [thread.name for thread in threading.enumerate()]


needs_pyigtl = pytest.mark.skipif(
    importlib.util.find_spec("pyigtl") is None, reason="the other implementation is not installed: pip install pyigtl"
)
#: pyigtl as a server of two tools; in a process of its own, since it takes over the signals.
PEER = """
import sys, time, numpy, pyigtl
server = pyigtl.OpenIGTLinkServer(port=int(sys.argv[1]))
left, right = numpy.eye(4), numpy.array([[0, -1, 0, 10.0], [1, 0, 0, -20.0], [0, 0, 1, 30.5], [0, 0, 0, 1]])
print("ready", flush=True)
while True:
    for name, matrix in (("LeftToWorld", left), ("RightToWorld", right)):
        server.send_message(pyigtl.StringMessage("passed by", device_name=name), wait=False)
        server.send_message(pyigtl.TransformMessage(matrix, device_name=name), wait=False)
    time.sleep(0.01)
"""


@contextmanager
def pyigtl_server(port: int) -> Iterator[None]:
    command = [sys.executable, "-c", PEER, str(port)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, stderr=subprocess.DEVNULL) as peer:
        assert peer.stdout is not None
        try:
            assert peer.stdout.readline() == "ready\n"
            yield
        finally:
            peer.kill()


@needs_pyigtl
def test_a_server_of_pyigtl_moves_the_instruments_and_may_go_and_return() -> None:
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        port = held.getsockname()[1]
    with pyigtl_server(port):
        polling = Polling(driver := opened(port))
        polling.until(lambda poses: bool(poses.position[1, 2] == 30.5))
    assert polling.last.position.tolist() == [[0.0, 0.0, 0.0], [10.0, -20.0, 30.5]]
    np.testing.assert_allclose(polling.last.quaternion[1], [np.sqrt(0.5), 0, 0, np.sqrt(0.5)], rtol=0, atol=1e-15)
    polling.until(none_seen)
    time.sleep(0.1)
    with pyigtl_server(port):
        polling.until(all_seen)
        driver.close()
    assert driver.summary()["reconnects"] == 1
