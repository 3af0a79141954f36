"""A live device outside of a session: how its records arrive, and what a sensor that is held still says."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from simulated_devices import SHORT, loaded, simulated
from waiting import PATIENCE_S, wait_for

from trainer.calibration import CalibrationError
from trainer.config import ConfigError
from trainer.drivers import minibird_stream, watch
from trainer.drivers.minibird_record import Sample
from trainer.drivers.serial_port import DeviceError
from trainer.drivers.watch import STILL_MM, Watch
from trainer.geometry import Array
from trainer.profile import load_profile
from trainer.simulators.hands import REST_MM


@pytest.fixture(autouse=True)
def hurried(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watch, "UNHURRIED", SHORT)


def test_a_device_at_rest_is_seen_where_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Bird k rests at (300, 50 k, 0) mm, which a word of 36 in / 8192 says within half its step of 0.11 mm; a touch
    is the mean of such words, all alike. Tilted alike, its quaternion is wrong by 2/32768 in a component at the most.
    """
    monkeypatch.setattr(watch, "STILL_S", 2.0)  # 1 % of what comes in that time will do
    with simulated(tmp_path) as path, Watch(loaded(path), keep_s=PATIENCE_S) as device:
        position, quaternion = device.touch(2)
        assert wait_for(lambda: device.arrival().records > 1000)
        arrived, seen = device.arrival(), device.seen()
    np.testing.assert_allclose(position, [REST_MM, 50.0, 0.0], rtol=0, atol=0.5 * 36 * 25.4 / 8192)
    assert np.linalg.norm(quaternion) == pytest.approx(1.0, abs=1e-12)
    assert arrived.duration_s < PATIENCE_S
    assert {name: tool for name, (tool, _) in seen.items()} == {"bird1": "right", "bird2": "left"}
    for _, found in seen.values():
        assert found.seen_percent > 0.0
        assert found.position_mm is not None
        assert found.closure == pytest.approx(0.0, abs=2 / 740)  # the converter's last digit, of 740
    assert device.flaws["good"] > 100


def test_what_is_silent_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is not connected again while it is looked at, which has words of its own."""
    monkeypatch.setattr(minibird_stream, "RETRY_S", PATIENCE_S)
    with simulated(tmp_path, "--fault", "mute") as path, Watch(loaded(path), keep_s=1.0) as device:
        assert wait_for(lambda: bool(device.trouble))
        with pytest.raises(CalibrationError, match="bird 1: bird 1 is silent"):
            device.poses(1, 0.1)
        assert device.arrival().records == 0
        assert device.seen()["bird1"][1].position_mm is None


def test_a_silent_device_forgets_what_it_was_and_counts_what_it_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    """By a clock of the test, with one second kept: 103 records a second for half a second, then 0.7 s of silence.

    31 records are younger than a second then, the first of them 0.7 s and 30 periods old: 103 were due since with it.
    """
    now = [0.0]
    takes: list[Callable[[Sample], None]] = []

    def stream(spec: object, take: Callable[[Sample], None], silences: object) -> SimpleNamespace:
        takes.append(take)
        return SimpleNamespace(start=lambda: None, close=lambda: None)

    monkeypatch.setattr(watch, "FlockStream", stream)
    monkeypatch.setattr(watch, "time", SimpleNamespace(monotonic=lambda: now[0]))
    profile = load_profile("minibird-pair").profile
    with Watch(replace(profile, closure=None), keep_s=1.0) as device:
        for k in range(52):
            now[0] = (k + 1) / 103.0
            takes[0](Sample(1, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), now[0], now[0], ""))
        assert device.arrival().records == 52
        assert device.arrival().lost == 0
        now[0] += 0.7
        arrived, seen = device.arrival(), device.seen()
    assert arrived.records == 31
    assert arrived.duration_s == pytest.approx(0.7 + 30 / 103.0)
    assert arrived.lost == 103 - 31
    assert seen["bird1"][1].seen_percent == pytest.approx(100.0 * 31 / 103)


def still(strayed_mm: float) -> Watch:
    """A device of which a sensor said 20 times the same, but once something else by so much."""
    position: Array = np.zeros((20, 3))
    position[7, 1] = strayed_mm
    quaternion: Array = np.tile([1.0, 0.0, 0.0, 0.0], (20, 1))
    quaternion[::2] *= -1.0  # the same rotation
    device = Watch.__new__(Watch)
    device.poses = lambda address, seconds: (position, quaternion)  # type: ignore[method-assign]
    return device


def test_a_touch_is_a_mean_of_what_is_held_still() -> None:
    """One of 20 readings strays by d: the mean by d / 20, so that one is 19/20 d away from it."""
    limit = STILL_MM * 20 / 19
    position, quaternion = still(0.99 * limit).touch(1)
    np.testing.assert_allclose(position, [0.0, 0.99 * limit / 20, 0.0], rtol=0, atol=1e-12)
    assert abs(quaternion[0]) == pytest.approx(1.0, abs=1e-12)
    with pytest.raises(CalibrationError, match=r"the sensor moved by 1\.5 mm; hold it still"):
        still(1.01 * limit).touch(1)


def test_only_a_live_device_is_looked_at() -> None:
    with pytest.raises(ConfigError, match="'scripted-expert' cannot be read now, only miniBIRDs can"):
        Watch(load_profile("scripted-expert").profile, 1.0)


def test_a_watch_that_cannot_begin_leaves_nothing_open(tmp_path: Path) -> None:
    """The closure sensor's port is free again after the flock was refused."""
    with simulated(tmp_path, "--fault", "no-bird=2") as path:
        for _ in range(2):
            with pytest.raises(DeviceError, match="bird 2 is not there"):
                Watch(loaded(path), 1.0)
