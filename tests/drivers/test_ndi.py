"""An NDI tracker behind a library of the real one's shape: frames, sensors out of sight, a cable pulled out."""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from live_polling import HOME, TICK_HZ, TOOLS, Polling, all_seen, none_seen

from trainer.config import ConfigError
from trainer.drivers import connected, ndi
from trainer.drivers.connected import Connected
from trainer.drivers.live import LivePoses
from trainer.drivers.ndi import UNSEEN, Tracker
from trainer.drivers.serial_port import DeviceError
from trainer.profile import NdiSpec, Tracked

SENSORS = (Tracked(name="port1", tool="right"), Tracked(name="port2", tool="left"))
AURORA = NdiSpec(tracker="aurora", sensor=SENSORS, port="/dev/ttyUSB7")
LEFT = np.array([[0.5, 0.5, 0.5, 0.5, 7.0, 8.0, 9.0]])
RIGHT = np.array([[1.0, 0.0, 0.0, 0.0, -4.0, -5.0, -6.0]])
NOWHERE = np.full((1, 7), np.nan)


class NDITracker:
    """What scikit-surgerynditracker 1.0.6 documents: a configuration, four methods, a tuple of five lists a frame."""

    made: list[NDITracker] = []  # noqa: RUF012
    sensors = 2
    poses: tuple[Any, Any] = (RIGHT, LEFT)
    fault: Exception | None = None
    frozen = False

    def __init__(self, configuration: dict[str, Any]) -> None:
        if self.fault is not None:
            raise self.fault
        self.configuration = configuration
        self.state = "ready"
        self.frame = 0.0
        print("the library greets")
        NDITracker.made.append(self)

    def get_tool_descriptions(self) -> tuple[list[int], list[int]]:
        return list(range(10, 10 + self.sensors)), list(range(self.sensors))

    def start_tracking(self) -> None:
        assert self.state == "ready"
        self.state = "tracking"

    def get_frame(self) -> tuple[list[int], list[float], list[float], list[Any], list[float]]:
        assert self.state == "tracking"
        if self.fault is not None:
            raise self.fault
        self.frame += 0.0 if self.frozen else 0.5  # each frame is told twice
        n = self.sensors
        return list(range(n)), [0.0] * n, [float(int(self.frame))] * n, list(self.poses), [0.1] * n

    def close(self) -> None:
        if self.state == "closed":
            raise ValueError("close called with no NDI device")
        self.state = "closed"


@pytest.fixture(autouse=True)
def library(monkeypatch: pytest.MonkeyPatch) -> type[NDITracker]:
    package, module = ModuleType("sksurgerynditracker"), ModuleType("sksurgerynditracker.nditracker")
    module.NDITracker = NDITracker  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, package.__name__, package)
    monkeypatch.setitem(sys.modules, module.__name__, module)
    for name in ("sensors", "poses", "fault", "frozen"):  # as the class has them, whatever a test sets
        monkeypatch.setattr(NDITracker, name, getattr(NDITracker, name))
    monkeypatch.setattr(NDITracker, "made", [])
    return NDITracker


def opened(spec: NdiSpec = AURORA, beside: Path = Path()) -> LivePoses:
    source = partial(Connected, "ndi", partial(Tracker, spec, beside))
    return LivePoses(source, spec, spec.sensor, None, TOOLS, TICK_HZ, HOME)


def moved(polling: Polling) -> None:
    polling.until(lambda poses: not (poses.position == HOME.position).any())


def test_frames_move_the_instruments_each_once(library: type[NDITracker]) -> None:
    polling = Polling(driver := opened())
    moved(polling)
    driver.close()
    assert polling.last.position.tolist() == [[7.0, 8.0, 9.0], [-4.0, -5.0, -6.0]]
    assert polling.last.quaternion.tolist() == [[0.5, 0.5, 0.5, 0.5], [1.0, 0.0, 0.0, 0.0]]
    [tracker] = library.made
    assert tracker.state == "closed"
    wanted = {"tracker type": "aurora", "serial port": "/dev/ttyUSB7", "use quaternions": True}
    assert tracker.configuration == wanted
    # Two sensors' readings for each frame number, 0 included, however often it was told.
    assert driver.summary()["readings"] == {"good": 2 * (int(tracker.frame) + 1)}


@pytest.mark.parametrize(
    ("pose", "reason"),
    [
        (NOWHERE, UNSEEN),
        (np.array([[0.9, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]]), "what comes is no pose"),
        (np.array([[1.0, 0.0, 0.0, 0.0, -3.7e28, 0.0, 0.0]]), "what comes is no pose"),
    ],
)
def test_a_sensor_out_of_sight_is_lost_alone_and_comes_back(
    library: type[NDITracker], pose: np.ndarray, reason: str
) -> None:
    polling = Polling(driver := opened())
    moved(polling)
    library.poses = (pose, LEFT)
    polling.until(lambda poses: poses.valid.tolist() == [True, False] and reason in polling.reasons())
    library.poses = (RIGHT, LEFT)
    polling.until(all_seen)
    driver.close()


@pytest.mark.parametrize("fault", ["raises", "freezes"])
def test_a_tracker_that_goes_is_opened_again(
    library: type[NDITracker], fault: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its library raises, or repeats the last frame for ever. On a busy machine the next one may seem to as well."""
    monkeypatch.setattr(ndi, "SILENT_S", 0.3)
    monkeypatch.setattr(connected, "RETRY_S", 2.0)  # in which the reason is heard
    polling = Polling(driver := opened())
    moved(polling)
    [first] = library.made
    if fault == "raises":
        first.fault = OSError("no reply\nfrom the device")
    else:
        first.frozen = True
    polling.until(none_seen)
    polling.until(lambda poses: bool(poses.valid.all()) and len(library.made) >= 2)
    driver.close()
    assert first.state == "closed"
    assert driver.summary()["reconnects"] == len(library.made) - 1
    expected = "no reply from the device" if fault == "raises" else "the tracker has stopped"
    assert f"/dev/ttyUSB7: {expected}" in polling.reasons()


def test_rom_files_lie_beside_the_profile(library: type[NDITracker], tmp_path: Path) -> None:
    spec = NdiSpec(tracker="vega", sensor=SENSORS, host="192.0.2.1", rom=("a.rom", "b.rom"))
    with pytest.raises(ConfigError, match=r"a\.rom: no such ROM file"):
        Tracker(spec, tmp_path)
    for rom in spec.rom:
        (tmp_path / rom).write_bytes(b"")
    Tracker(spec, tmp_path).close()
    assert library.made[0].configuration == {
        "tracker type": "vega",
        "romfiles": [str(tmp_path / "a.rom"), str(tmp_path / "b.rom")],
        "ip address": "192.0.2.1",
        "port": 8765,
        "use quaternions": True,
    }


def test_what_cannot_be_opened_is_one_line(library: type[NDITracker]) -> None:
    library.sensors = 1
    with pytest.raises(DeviceError, match=r"^/dev/ttyUSB7: the tracker has 1 sensors, the profile names 2$"):
        opened()
    assert library.made[0].state == "closed"
    library.fault = OSError("Could not connect\n\n  Please check: ...")
    with pytest.raises(DeviceError, match=r"^/dev/ttyUSB7: Could not connect Please check: \.\.\.$"):
        opened()


def test_a_missing_package_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "sksurgerynditracker.nditracker", None)
    with pytest.raises(ConfigError, match="needs a package that is not installed: pip install scikit-surgerynditra"):
        opened(replace(AURORA, scale=2.0))
