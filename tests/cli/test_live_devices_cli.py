"""``trainer devices monitor`` and ``calibrate`` with a device in the hand, which a simulator plays."""

from __future__ import annotations

import io
import json
import os
import signal
import threading
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from conftest import CommandLine
from simulated_devices import SHORT, simulated
from waiting import PATIENCE_S

from trainer import session
from trainer.cli import calibrate
from trainer.drivers import calibrate as fits
from trainer.drivers import minibird_stream, watch
from trainer.drivers.minibird_record import Sample
from trainer.geometry import Array, Rigid, quaternion_from_euler_deg
from trainer.session import interruptible

TIP = np.array([2.0, -1.0, 90.0])  # mm, sensor_from_tool
PIVOT = np.array([250.0, 20.0, 30.0])  # mm, in the transmitter's frame, well inside the forward hemisphere
SWEEP_HZ = 100.0


@pytest.fixture(autouse=True)
def hurried(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watch, "UNHURRIED", SHORT)


def test_a_device_in_the_hand_is_monitored(
    command_line: CommandLine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As one document, and as a table where stdout is no terminal; Ctrl-C ends one without ``--seconds``."""
    with simulated(tmp_path) as profile:
        code, out, err = command_line("devices", "monitor", profile, "--seconds", "2", "--json")
        assert (code, err) == (0, "")
        got = json.loads(out)
        assert (got["device"], got["calibration"], list(got["sensors"])) == ("minibird-pair", None, ["bird1", "bird2"])
        assert got["records"] > 50  # of two thousand
        assert got["flaws"]["good"] >= got["records"]
        assert got["sensors"]["bird1"]["tool"] == "right"
        begun, taken, listening = interruptible, watch.Watch._take, threading.Event()

        @contextmanager
        def interrupted() -> Iterator[Callable[[], bool]]:
            with begun() as asked:
                listening.set()
                yield asked

        def take(device: watch.Watch, sample: Sample) -> None:
            """Ctrl-C when a record comes and it is no longer an error."""
            taken(device, sample)
            if listening.is_set():
                listening.clear()
                os.kill(os.getpid(), signal.SIGINT)

        monkeypatch.setattr(session, "interruptible", interrupted)
        monkeypatch.setattr(watch.Watch, "_take", take)
        code, out, _ = command_line("devices", "monitor", profile)
        assert code == 0
        for text in ("minibird-pair", "bird2 (left)", "Hz", "not calibrated"):
            assert text in out


def test_a_device_of_which_nothing_comes_is_shown_and_is_a_failure(
    command_line: CommandLine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The table or the document is complete, what is wrong stands below it and on stderr, in one line. Silence is
    noticed soon, and the flock is not connected again meanwhile, which has words of its own."""
    monkeypatch.setattr(minibird_stream, "SILENT_S", 0.1)
    monkeypatch.setattr(minibird_stream, "RETRY_S", PATIENCE_S)
    complaint = "trainer: device 'minibird-pair': no record came; bird 1 is silent\n"
    with simulated(tmp_path, "--fault", "mute") as profile:
        code, out, err = command_line("devices", "monitor", profile, "--seconds", "2")
        assert (code, err) == (1, complaint)
        assert "bird 1 is silent" in out
        code, out, err = command_line("devices", "monitor", profile, "--seconds", "2", "--json")
    assert (code, err) == (1, complaint)
    got = json.loads(out)
    assert (got["records"], got["flaws"], got["trouble"]) == (0, {}, "bird 1 is silent")


def swept(path: Path) -> None:
    """A PLUS sequence of both sensors: the tips rest in a dimple, the tools tilt by 35° all around it."""
    names = ("Bird1", "Bird2")
    lines = ["ObjectType = Image", "DimSize = 0 0 3000"]
    for k in range(3000):
        angle = 2.0 * np.pi * k / 600.0
        turned = Rigid(np.zeros(3), quaternion_from_euler_deg([35.0 * np.cos(angle), 35.0 * np.sin(angle), 0.0]))
        matrix: Array = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = turned.matrix, PIVOT - turned.apply(TIP)
        numbers = " ".join(f"{v:.9f}" for v in matrix.ravel())
        lines += [f"Seq_Frame{k:04d}_{name}ToTrackerTransform = {numbers}" for name in names]
        lines += [f"Seq_Frame{k:04d}_FrameNumber = {k}", f"Seq_Frame{k:04d}_Timestamp = {k / SWEEP_HZ}"]
    path.write_text("\n".join([*lines, "ElementDataFile = LOCAL", ""]))


def test_a_live_sweep_finds_the_tip(command_line: CommandLine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Positions are rounded to words of 0.11 mm, which is 0.03 mm rms, quaternions to 2e-5 rms in a component, which
    moves a tip 90 mm away by 0.004 mm: fifty poses and more leave the tip within a tenth of a millimetre. Of the
    sweep's 30 s three quarters are heard."""
    swept(tmp_path / "sweep.igs.mha")
    monkeypatch.setattr(calibrate, "SWEEP_S", 2.3)
    monkeypatch.setattr("sys.stdin", io.StringIO("\n"))
    with simulated(tmp_path / "out", "--motion", str(tmp_path / "sweep.igs.mha")) as profile:
        code, out, err = command_line("devices", "calibrate", profile, "--sensor", "bird1", "--sweep", "live", "--json")
    assert code == 0, err
    (tip,) = json.loads(out)["tip"]
    assert tip["sensor"] == "bird1"
    np.testing.assert_allclose(tip["position_mm"], TIP, rtol=0, atol=0.1)
    kept = tomllib.loads(Path(json.loads(out)["path"]).read_text())
    assert kept["calibration"]["tip"][0]["position_mm"] == tip["position_mm"]


def test_points_are_touched_one_after_the_other(
    command_line: CommandLine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A table of places without readings: the device is read at each, again where it was not held still."""
    places = np.array([[0.0, 0.0, 0.0], [30.0, 0.0, 0.0], [0.0, 40.0, 0.0], [10.0, 10.0, 20.0]])
    scene_from_device = Rigid(np.array([-300.0, 5.0, 7.0]), quaternion_from_euler_deg([180.0, 0.0, 20.0]))
    device = [scene_from_device.inverse().apply(place) for place in places]
    asked: list[int] = []

    def touch(self: watch.Watch, address: int) -> tuple[Array, Array]:
        asked.append(address)
        if len(asked) == 2:
            raise watch.CalibrationError("the sensor moved by 9.0 mm; hold it still for 1 s")
        return np.asarray(device[(len(asked) - 1 - (len(asked) > 2)) % 4]), np.array([1.0, 0.0, 0.0, 0.0])

    monkeypatch.setattr(watch.Watch, "touch", touch)
    table = tmp_path / "places.csv"
    table.write_text("scene_x_mm,scene_y_mm,scene_z_mm\n" + "".join(f"{x},{y},{z}\n" for x, y, z in places))
    with simulated(tmp_path / "out") as profile:
        text = profile.read_text().replace('anchor = "home"', 'anchor = "none"').replace("scale = 0.1", "scale = 1.0")
        profile.write_text(text)
        monkeypatch.setattr("sys.stdin", io.StringIO("\n" * 5))
        code, out, err = command_line("devices", "calibrate", profile, "--sensor", "bird2", "--points", table, "--json")
        assert code == 0, err
        assert asked == [2] * 5
        assert "moved by 9.0 mm; hold it still for 1 s; again" in err
        found = json.loads(out)["scene"]
        np.testing.assert_allclose(found["position_mm"], [-300.0, 5.0, 7.0], rtol=0, atol=1e-6)
        assert found["residual_mm"] < 1e-6
        (kept,) = (tmp_path / "out").glob("*.readings-*-points.csv")
        read = fits.read_readings(kept)
        np.testing.assert_array_equal(read.position, device)
        np.testing.assert_array_equal(read.known, places)
        kept.unlink()
        monkeypatch.setattr("sys.stdin", io.StringIO("\n"))
        code, out, err = command_line("devices", "calibrate", profile, "--sensor", "bird2", "--points", table)
        assert code == 1
        assert "the input ended before all was measured; no calibration is made" in err
        (kept,) = (tmp_path / "out").glob("*.readings-*-points.csv")
        assert len(fits.read_readings(kept).position) == 1
        kept.unlink()
        monkeypatch.setattr("sys.stdin", io.StringIO(""))
        assert command_line("devices", "calibrate", profile, "--sensor", "bird2", "--points", table)[0] == 1
        assert list((tmp_path / "out").glob("*.readings-*")) == []
        profile.write_text(text.replace('anchor = "none"', 'anchor = "home"'))
        before = len(asked)
        code, out, err = command_line("devices", "calibrate", profile, "--sensor", "bird2", "--points", table)
        assert (code, len(asked)) == (1, before)
        assert 'set anchor = "none" in [minibird]' in err
    assert len(list((tmp_path / "out").glob("*.calibration-*.toml"))) == 1
