"""miniBIRDs through bytes, a pseudo-terminal and pyserial: every pose arrives, every fault is survived or told.

The devices are processes of their own. What they do is timed in seconds of motion, ten to one of the clock's.
"""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import serial
from live_polling import HOME, TICK_HZ, TOOLS, Polling, all_seen, none_seen
from simulated_devices import SHORT, loaded, simulated
from waiting import PATIENCE_S

from trainer.config import ConfigError
from trainer.drivers import minibird_stream, sequence_file
from trainer.drivers.closure import OUT_OF_RANGE, SILENT
from trainer.drivers.minibird import Minibird
from trainer.drivers.minibird_flock import UNHURRIED, Flock, Silences
from trainer.drivers.minibird_record import MIRROR, Sample
from trainer.drivers.serial_port import DeviceError, read_some
from trainer.poses import ToolPoses
from trainer.profile import Bird, MinibirdSpec, Profile
from trainer.simulators.faults import Faults, Span, parse

REAL = Path(__file__).parents[3] / "shared/data/tracker/WaterTankBottomTranslationTrackerBuffer.igs.mha"
needs_real = pytest.mark.skipif(not REAL.exists(), reason=f"the real recording {REAL.name} is not beside the checkout")


@pytest.fixture(scope="module")
def healthy(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Profile]:
    """A pair of birds at rest and a closure board, for the tests that need nothing else."""
    with simulated(tmp_path_factory.mktemp("healthy")) as path:
        yield loaded(path)


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine that is busy with something else keeps records back: no bird is silent for that."""
    monkeypatch.setattr(minibird_stream, "SILENT_S", PATIENCE_S)


def spec_of(profile: Profile) -> MinibirdSpec:
    assert profile.minibird is not None
    return profile.minibird


def opened(profile: Profile, silences: Silences = SHORT) -> Minibird:
    return Minibird(spec_of(profile), profile.closure, TOOLS, TICK_HZ, HOME, silences)


def said(summary: dict[str, Any], *reasons: str) -> bool:
    """Whether both instruments were lost, and are back, with all of ``reasons`` at least once."""
    return all(
        any(loss["tool"] == t and r in loss["reason"] for loss in summary["lost"]) for t in TOOLS for r in reasons
    )


@needs_real
@pytest.mark.parametrize("speed", [20.0, *([1.0] if os.environ.get("TRAINER_LONG") else [])])
def test_every_position_of_the_real_recording_arrives(tmp_path: Path, speed: float) -> None:
    """5000 frames of three sensors, in order. Positions lie on the tracker's own grid of 36 in / 8192, printed with
    six digits (0.5 µm), so the words lose nothing: they come back as the recording's text has them within 1 µm.

    A component of a quaternion is rounded by up to 2/32768, the angle by up to twice 2 · 2/32768 rad = 0.014°; the six
    digits of the recording's matrices add less than 0.001°. Asked for are 0.022°, the step of the tracker's angles.
    TRAINER_LONG also plays it at real speed, in 125 s.
    """
    sequence = sequence_file.read(REAL)
    profile = tmp_path / "three.toml"
    # The second of three birds is on the bus, though it moves no instrument.
    birds = "".join(f'[[minibird.bird]]\naddress = {a}\ntool = "{t}"\n' for a, t in [(1, "left"), (3, "right")])
    profile.write_text(f'name = "three"\ndriver = "minibird"\nsummary = ""\n[minibird]\nport = "x"\n{birds}')
    found: dict[int, list[Sample]] = {1: [], 2: [], 3: []}
    with simulated(tmp_path / "out", "--motion", str(REAL), profile=str(profile), speed=speed) as path:
        silences = SHORT if speed > 1.0 else UNHURRIED
        flock = Flock(replace(spec_of(loaded(path)), quaternion="direct"), silences)
        flock.connect()
        [(port, parser)] = flock.begin().values()
        ends = time.monotonic() + sequence.duration_s / speed + PATIENCE_S
        while sum(map(len, found.values())) < 15000 and time.monotonic() < ends:
            for sample in parser.feed(read_some(port), time.monotonic()):
                found[sample.address].append(sample)
        flock.disconnect()
    for samples, track in zip(found.values(), sequence.tracks.values(), strict=True):
        assert [s.flaw for s in samples] == [""] * 5000
        np.testing.assert_allclose([s.position for s in samples], track.position, rtol=0, atol=1e-3)
        q = np.array([s.quaternion for s in samples])
        twice_sine = 2 * np.linalg.norm(
            np.cross(q[:, 1:], track.quaternion[:, 1:])
            - q[:, :1] * track.quaternion[:, 1:]
            + track.quaternion[:, :1] * q[:, 1:],
            axis=1,
        )
        assert np.degrees(twice_sine.max()) <= 0.022


@pytest.mark.usefixtures("patient")
def test_a_session_of_poses_comes_through_and_its_summary_tells(healthy: Profile) -> None:
    driver = opened(healthy)
    polling = Polling(driver)
    polling.until(all_seen, lambda summary: summary["latency_ms"]["poses"] > 200)
    np.testing.assert_allclose(polling.last.position, HOME.position, rtol=0, atol=1e-9)  # at rest where home is
    np.testing.assert_allclose(polling.last.closure, 0.0, atol=2 / 740)  # the converter's last digit, of 740
    driver.close()
    summary = polling.summary()
    assert summary["driver"] == "minibird"
    assert set(summary["records"]) <= {"good", "dropped bytes", "first after dropped bytes"}
    assert summary["restarts"] == 0, f"{summary}"


def test_the_sense_of_quaternions_is_found_by_comparing_with_angles(healthy: Profile) -> None:
    flock = Flock(spec_of(healthy), SHORT)
    flock.connect()
    flock.disconnect()
    assert flock.inverse == {1: False, 2: False}


def test_a_noisy_line_costs_records_and_nothing_else(tmp_path: Path) -> None:
    """1 % of bytes dropped, 0.1 % of bits flipped, bursts of 1 to 60 lost, extra bytes, exact splices, split writes."""
    faults = (
        "drop=0.01",
        "flip=0.001",
        "burst=0.0005",
        "extra=0.001",
        "splice=0.0005",
        "split",
        "bunch",
        "closure:flip=0.001",
    )
    with simulated(tmp_path, *(a for f in faults for a in ("--fault", f))) as path:
        profile = loaded(path)
        # What is asked for in the conversation is spoilt as well: it is asked again until it is not.
        driver = persistent(profile)
        polling = Polling(driver)
        farthest = 0.0

        def strayed(poses: ToolPoses) -> bool:
            nonlocal farthest
            farthest = max(farthest, float(np.abs(poses.position - HOME.position).max()))
            return True

        polling.until(strayed, lambda summary: summary["records"].get("good", 0) > 1000)
        driver.close()
    records = polling.summary()["records"]
    assert isinstance(records, dict)
    assert records["dropped bytes"] > 0
    assert sum(records.values()) > records["good"]
    # at rest: whatever passed the gates moved an instrument by no more than a gate lets pass
    assert farthest < 0.1 * 60.0


def persistent(profile: Profile) -> Minibird:
    for _ in range(30):
        try:
            return opened(profile, replace(SHORT, answer_s=0.2))
        except DeviceError:
            continue
    raise AssertionError("no conversation in thirty tries")


@pytest.mark.parametrize(
    ("fault", "reasons"), [("power-cycle=3:8", ("is silent",)), ("unplug=3:50", ("the port is gone", "no such port"))]
)
def test_a_power_cycle_and_an_unplugged_cable_are_survived(
    tmp_path: Path, fault: str, reasons: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Power is off for 0.8 s of the clock's, or the cable is out for 5 s: the instruments are lost with the reason, the
    flock is configured anew, and they are back. Each reason lasts for seconds; a flock without power gives no answer.
    """
    monkeypatch.setattr(minibird_stream, "RETRY_S", 2.0)
    with simulated(tmp_path, "--fault", fault) as path:
        driver = opened(loaded(path), replace(SHORT, answer_s=1.0))
        polling = Polling(driver)
        polling.until(all_seen, lambda summary: said(summary, *reasons))
        driver.close()
    assert polling.summary()["restarts"] >= 1


@pytest.mark.usefixtures("patient")
def test_a_pause_and_another_hemisphere_freeze_without_a_restart(tmp_path: Path) -> None:
    """A pause of 0.2 s of the clock and 2 s with every position's sign changed."""
    faults = ("pause=3:2", "hemisphere=8:20")
    with simulated(tmp_path, *(a for f in faults for a in ("--fault", f))) as path:
        driver = opened(loaded(path))
        polling = Polling(driver)
        polling.until(all_seen, lambda summary: said(summary, MIRROR))
        driver.close()
    summary = polling.summary()
    assert summary["records"][MIRROR] > 10
    assert summary["restarts"] == 0


def test_a_closure_sensor_that_says_nothing_or_nonsense_freezes_its_jaws(tmp_path: Path) -> None:
    """For a second each: a board whose process sleeps that long on a busy machine leaves out what it would say."""
    faults = ("closure:pause=2:10", "closure:out-of-range=14:10", "closure:unplug=26:10")
    with simulated(tmp_path, *(a for f in faults for a in ("--fault", f))) as path:
        driver = opened(loaded(path))
        polling = Polling(driver)
        polling.until(all_seen, lambda summary: said(summary, SILENT) and said(summary, OUT_OF_RANGE))
        polling.until(all_seen, lambda summary: summary["closure"]["reopened"] == 1)
        driver.close()


def test_what_is_no_flock_is_one_line(tmp_path: Path) -> None:
    silences = replace(SHORT, answer_s=0.2)
    complaint = r"bird 1 answers nothing|no tracker's answers|talks without end"
    with simulated(tmp_path, "--fault", "garbage") as path, pytest.raises(DeviceError, match=complaint) as told:
        opened(loaded(path), silences)
    assert str(told.value).startswith(str(tmp_path / "flock"))


def test_a_missing_bird_and_another_baud_rate_are_one_line_each(tmp_path: Path) -> None:
    """The baud rate at last: what the units hear may be half a command, of which they go on waiting for the rest."""
    with simulated(tmp_path, "--fault", "no-bird=2") as path:
        spec = spec_of(loaded(path))
        with pytest.raises(DeviceError, match="bird 2 is not there; check its power") as told:
            opened(loaded(path))
        assert str(told.value).startswith(spec.port)
        with pytest.raises(DeviceError, match="baud rate 9600"):
            Flock(replace(spec, baud=9600), replace(SHORT, answer_s=0.2)).connect()


def test_a_stream_that_never_starts_is_told_and_tried_again(tmp_path: Path) -> None:
    with simulated(tmp_path, "--fault", "mute") as path:
        driver = opened(loaded(path))
        polling = Polling(driver)
        polling.until(none_seen)
        polling.until(none_seen, lambda summary: summary["restarts"] >= 1)
        driver.close()
    assert said(polling.summary(), "bird 1 is silent")


def test_a_port_in_use_is_one_line(healthy: Profile) -> None:
    spec = spec_of(healthy)
    with serial.Serial(spec.port, exclusive=True), pytest.raises(DeviceError, match="in use by another program"):
        opened(healthy)


@pytest.mark.parametrize(
    ("port", "complaint"),
    [
        ("{folder}/nothing", "no such port; plug the device in"),
        ("nonsense://here", "cannot be opened"),
        ("socket://127.0.0.1:{unused}", "nobody answers there; start what serves the port"),
    ],
)
def test_a_port_that_is_not_there_is_one_line(tmp_path: Path, healthy: Profile, port: str, complaint: str) -> None:
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        url = port.format(folder=tmp_path, unused=held.getsockname()[1])
        with pytest.raises(DeviceError, match=complaint) as told:
            Flock(replace(spec_of(healthy), port=url), SHORT).connect()
    assert str(told.value).startswith(url)
    assert "\n" not in str(told.value)


@pytest.mark.parametrize(
    ("port", "complaint"),
    [("{tty}", "the port is gone; plug it in again"), ("spy://{tty}?file=/dev/full", "its log .* the disk is full")],
)
def test_what_fails_while_connecting_is_one_line(port: str, complaint: str) -> None:
    """A plug that is pulled out during the silence after opening, and a full disk. /dev/full is Linux's."""
    master, slave = os.openpty()
    url = port.format(tty=os.ttyname(slave))
    os.close(slave)
    if "/dev/full" in url and not Path("/dev/full").exists():
        pytest.skip("no /dev/full here")
    open_ends = [master]

    def pause(seconds: float) -> None:
        if "/dev/full" not in url and open_ends:
            os.close(open_ends.pop())

    spec = MinibirdSpec(bird=(Bird(address=1, tool="left"),), port=url)
    with pytest.raises(DeviceError, match=f": {complaint}$") as told:
        Flock(spec, SHORT, pause).connect()
    assert str(told.value).startswith(url)
    for end in open_ends:
        os.close(end)


def test_a_flock_behind_a_socket_is_a_flock(healthy: Profile) -> None:
    """A bridge carries bytes between a socket on this machine and the port."""
    port = serial.Serial(spec_of(healthy).port, 115200, timeout=0.02)
    with socket.create_server(("127.0.0.1", 0)) as server:
        bridge = threading.Thread(target=carry, args=(server, port))
        bridge.start()
        spec = replace(spec_of(healthy), port=f"socket://127.0.0.1:{server.getsockname()[1]}")
        # A busy machine's bridge may be slow: what is still on its way must not pass for an answer.
        flock = Flock(spec, replace(SHORT, drain_s=0.5, answer_s=PATIENCE_S))
        flock.connect()
        [(line, parser)] = flock.begin().values()
        ends = time.monotonic() + PATIENCE_S
        found: list[Sample] = []
        while len(found) < 20 and time.monotonic() < ends:
            found += parser.feed(read_some(line), time.monotonic())
        flock.disconnect()
        bridge.join()
    assert [s.address for s in found[:4]] == [1, 2, 1, 2]


def carry(server: socket.socket, port: serial.Serial) -> None:
    connection, _ = server.accept()
    with connection, port:
        connection.settimeout(0.002)
        while True:
            try:
                data = connection.recv(4096)
            except TimeoutError:
                data = b""
            else:
                if not data:
                    return
            try:
                port.write(data)
                connection.sendall(port.read(port.in_waiting))
            except OSError:
                return


def test_a_bird_with_a_port_of_its_own_needs_no_group_mode(tmp_path: Path) -> None:
    profile = tmp_path / "own-ports.toml"
    birds = "".join(
        f'[[minibird.bird]]\naddress = {a}\ntool = "{t}"\nport = "p{a}"\n' for a, t in [(1, "left"), (2, "right")]
    )
    profile.write_text(f'name = "own-ports"\ndriver = "minibird"\nsummary = ""\n[minibird]\n{birds}')
    with simulated(tmp_path / "out", "--fault", "pause=3:8", profile=str(profile)) as path:
        driver = opened(loaded(path))
        polling = Polling(driver)
        polling.until(all_seen)
        polling.until(all_seen, lambda summary: summary["restarts"] >= 1)
        driver.close()
    assert polling.last.closure.tolist() == [1.0, 1.0]


def test_a_device_that_moves_nothing_of_the_task_is_refused(healthy: Profile) -> None:
    with pytest.raises(ConfigError, match="the device moves right, left; the task has third"):
        Minibird(spec_of(healthy), None, ("third",), 100.0, HOME, SHORT)


def test_faults_are_parsed_or_told() -> None:
    birds, closure = parse(["drop=0.5", "unplug=3:5", "split", "closure:pause=2:1", "no-bird=2"])
    assert birds == Faults(drop=0.5, unplug=Span(3, 5), split=True, no_bird=2)
    assert closure == Faults(pause=Span(2, 1))
    with pytest.raises(ConfigError, match="unknown fault 'dorp'; known: drop"):
        parse(["dorp=1"])
    for wrong in ("stuck=1:1", "closure:garbage", "closure:mute", "closure:power-cycle=1:1", "closure:no-bird=1"):
        with pytest.raises(ConfigError, match="cannot have it"):
            parse([wrong])
    numbers = ("drop=x", "drop=nan", "flip=-1", "burst=2", "no-bird=1.5", "no-bird=0")
    for wrong in (*numbers, "split=1", "pause=a:b", "pause=-1:1", "pause=1:0", "unplug=nan:1"):
        with pytest.raises(ConfigError, match="takes"):
            parse([wrong])
