"""Sessions over OpenIGTLink: one tells its poses to whoever listens, another is moved by what it hears."""

from __future__ import annotations

import json
import random
import re
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from conftest import CommandLine

from trainer import curriculum
from trainer.log import reader
from trainer.openigtlink import MessageParser, Transform
from trainer.poses import ToolPoses
from trainer.profile import load_profile
from trainer.sinks.igtlink import IgtlinkSink
from trainer.sinks.surface import TickRecord


@pytest.fixture
def task(tmp_path: Path) -> Path:
    """A second of needle-drive, for whoever holds the instruments."""
    path = tmp_path / "needle-drive.toml"
    text = curriculum.load_task("anastomosis/needle-drive").text
    path.write_text(re.sub(r"time_limit_s = .*", "time_limit_s = 1.0", text))
    return path


@pytest.fixture
def port() -> int:
    """A free one below those that the system gives to clients: who tries again and again to connect to one of those
    will be connected to itself some day."""
    for found in random.SystemRandom().sample(range(20_000, 30_000), 100):
        with socket.socket() as held, suppress(OSError):
            held.bind(("127.0.0.1", found))
            return found
    raise AssertionError("no free port")


def test_a_session_tells_the_poses_that_it_logs(
    command_line: CommandLine,
    task: Path,
    port: int,
    tmp_path: Path,
    own_log: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What is heard are rows of the log, rounded to float32: 30 mm by 1e-6 mm. The first tick lasts until the listener
    is there."""
    profile = tmp_path / "told.toml"
    text = load_profile("scripted-expert").text.replace('"scripted-expert"', '"told"')
    profile.write_text(f"{text}\n[publish]\nport = {port}\n")
    heard: list[Transform] = []
    over = threading.Event()
    told = IgtlinkSink.tick

    def tick(sink: IgtlinkSink, record: TickRecord) -> None:
        told(sink, record)
        while record.tick == 0 and len(heard) < 2:
            assert listener.is_alive()
            time.sleep(0.002)
            told(sink, record)

    monkeypatch.setattr(IgtlinkSink, "tick", tick)
    listener = threading.Thread(target=listen, args=(port, heard, over))
    listener.start()
    code, out, err = command_line("practice", task, "--device", profile, "--fast", "--no-record", "--json")
    over.set()
    listener.join()
    assert code == 0, err
    assert json.loads(out)["outcome"] == "timeout"
    with reader.open_log(own_log) as log:
        logged = reader.load(log, json.loads(out)["session"])
    tools = {f"{tool.capitalize()}ToWorld": k for k, tool in enumerate(logged.header.tools)}
    assert {transform.device for transform in heard} == set(tools)
    for transform in heard:
        off = np.abs(logged.position[:, tools[transform.device]] - transform.position).max(axis=1)
        assert off.min() <= 2e-6


def listen(port: int, heard: list[Transform], over: threading.Event) -> None:
    """From when somebody publishes until nobody does."""
    parser = MessageParser()
    while not over.is_set():
        try:
            with socket.create_connection(("127.0.0.1", port)) as client:
                while data := client.recv(4096):
                    heard += parser.feed(data)
            return
        except OSError:
            time.sleep(0.002)


@pytest.fixture
def server() -> Iterator[int]:
    """Two tools at rest, told at 200 Hz."""
    sink, ended = IgtlinkSink("127.0.0.1", 0, ("forcepsLeft", "forcepsRight")), threading.Event()
    poses = ToolPoses(np.zeros((2, 3)), np.eye(4)[[0, 0]], np.zeros(2), np.ones(2, dtype=bool))

    def ticks() -> None:
        while not ended.wait(0.005):
            sink.tick(TickRecord(0, 0.0, poses, (), lambda: pytest.fail("no snapshot is asked for")))

    thread = threading.Thread(target=ticks)
    thread.start()
    yield sink.port
    ended.set()
    thread.join()
    sink.close()


def test_a_session_is_moved_by_what_it_hears(
    command_line: CommandLine, task: Path, server: int, tmp_path: Path
) -> None:
    """The shipped profile with this server's port and names. In the hand, the device paces the session."""
    profile = tmp_path / "openigtlink.toml"
    text = load_profile("openigtlink").text.replace("18944", str(server))
    text = text.replace("ForcepsRightToTracker", "ForcepsrightToWorld").replace("ForcepsLeftToT", "ForcepsleftToT")
    profile.write_text(text.replace("ForcepsleftToTracker", "ForcepsleftToWorld"))
    code, out, err = command_line("practice", task, "--device", profile, "--fast", "--no-record", "--json")
    assert code == 0, err
    device = json.loads(out)["device"]
    assert device["driver"] == "openigtlink"
    assert device["latency_ms"]["poses"] > 20
    assert device["readings"]["good"] > 20
    code, _, err = command_line("sessions", "replay", "last", "--verify")
    assert code == 0, err


def test_a_port_that_cannot_be_served_is_told_before_the_session_begins(
    command_line: CommandLine, task: Path, server: int, tmp_path: Path
) -> None:
    profile = tmp_path / "told.toml"
    text = load_profile("scripted-expert").text.replace('"scripted-expert"', '"told"')
    profile.write_text(f"{text}\n[publish]\nport = {server}\n")
    code, _, err = command_line("practice", task, "--device", profile, "--fast", "--no-record")
    assert code == 1
    assert err == f"trainer: 127.0.0.1:{server}: Address already in use; give 'port' in [publish] one that is free\n"
    assert json.loads(command_line("sessions", "list", "--json")[1]) == []
