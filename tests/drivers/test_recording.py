"""Recorded motion on the tick: exact for constant rates, honest about gaps, anchored where the task says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.drivers.format_samples import SAMPLES, put
from trainer.config import ConfigError
from trainer.curriculum import Task, load_task
from trainer.drivers import open_driver, open_profile, recording
from trainer.drivers.driver import Driver
from trainer.geometry import (
    Array,
    Rigid,
    matrix_from_quaternion,
    quaternion_from_axis_angle,
    quaternion_from_euler_deg,
)
from trainer.motion import Motion, Track
from trainer.poses import ToolPoses

REAL = Path(__file__).parents[3] / "shared/data/tracker/WaterTankBottomTranslationTrackerBuffer.igs.mha"
needs_real = pytest.mark.skipif(not REAL.exists(), reason=f"the real recording {REAL.name} is not beside the checkout")

START = np.array([5.0, 6.0, 7.0])  # mm
VELOCITY = np.array([3.0, -7.0, 11.0])  # mm/s
AXIS = np.array([0.36, 0.48, 0.8])
RATE = 2.5  # rad/s


@pytest.fixture(scope="module")
def task() -> Task:
    return load_task("anastomosis/needle-drive").task


@pytest.fixture(scope="module")
def home(task: Task) -> ToolPoses:
    instruments = task.scene.instrument
    return ToolPoses(
        position=np.array([i.home_mm for i in instruments]),
        quaternion=np.array([quaternion_from_euler_deg(i.home_rotation_deg) for i in instruments]),
        closure=np.array([0.25, 0.5]),
        valid=np.ones(2, dtype=bool),
    )


def sequence(time: Array, number: list[int] | None = None, ok: list[bool] | None = None) -> Motion:
    """One sensor with constant velocity and constant rate of rotation."""
    track = Track(
        position=START + np.outer(time - time[0], VELOCITY),
        quaternion=np.array([quaternion_from_axis_angle(AXIS, RATE * (t - time[0])) for t in time]),
        ok=np.ones(len(time), dtype=bool) if ok is None else np.array(ok),
    )
    frame_number = np.arange(len(time)) if number is None else np.array(number)
    return Motion("made", time, frame_number, {"ProbeToTracker": track})


def sampled(s: Motion, hz: float = 100.0) -> tuple[Array, Array, Array, np.ndarray]:
    time = recording.tick_times(s, hz)
    return time, *recording.resample(s, s.track("Probe"), time, hz)


def same_rotation(a: Array, b: Array, atol: float) -> None:
    np.testing.assert_allclose(matrix_from_quaternion(a), matrix_from_quaternion(b), rtol=0, atol=atol)


def drain(driver: Driver) -> list[ToolPoses]:
    out: list[ToolPoses] = []
    while (poses := driver.poll(len(out), None)) is not None:
        out.append(poses)
    return out


def write(path: Path, s: Motion, sensors: tuple[str, ...] = ("Probe", "Stylus")) -> Path:
    """The motion of ``s`` as a file, all digits written, for each of ``sensors``; Stylus 100 mm aside."""
    n = len(s.time)
    lines = ["ObjectType = Image", f"DimSize = 0 0 {n}", "ElementType = MET_UCHAR"]
    track = s.track("Probe")
    for k in range(n):
        m = np.eye(4)
        m[:3, :3], m[:3, 3] = matrix_from_quaternion(track.quaternion[k]), track.position[k]
        for i, sensor in enumerate(sensors):
            numbers = " ".join(repr(float(v)) for v in (m + i * 100.0 * np.eye(4, k=3)).ravel())
            lines.append(f"Seq_Frame{k:04d}_{sensor}ToTrackerTransform = {numbers}")
            lines.append(f"Seq_Frame{k:04d}_{sensor}ToTrackerTransformStatus = {'OK' if track.ok[k] else 'INVALID'}")
        lines.append(f"Seq_Frame{k:04d}_FrameNumber = {s.frame_number[k]}")
        lines.append(f"Seq_Frame{k:04d}_Timestamp = {float(s.time[k])!r}")
    path.write_text("\n".join([*lines, "ElementDataFile = LOCAL", ""]))
    return path


def test_constant_rates_are_met_exactly_on_an_irregular_clock() -> None:
    """Linear interpolation and slerp reproduce x = x0 + v t and q = exp(ω t / 2) at every tick.

    Each value comes from fewer than ten operations on numbers below 100, times below 1e4 s: rounding of the
    times, 2e-12 s, times the rates, stays below 1e-10.
    """
    rng = np.random.default_rng(3)
    s = sequence(7356.7117 + np.cumsum(rng.uniform(0.004, 0.07, 200)))
    time, position, quaternion, valid = sampled(s)
    np.testing.assert_allclose(position, START + np.outer(time, VELOCITY), rtol=0, atol=1e-10)
    same_rotation(quaternion, np.array([quaternion_from_axis_angle(AXIS, RATE * t) for t in time]), 1e-10)
    assert valid.all()


def test_the_sign_of_a_quaternion_does_not_matter() -> None:
    s = sequence(np.arange(20) * 0.021)
    flipped = sequence(np.arange(20) * 0.021)
    flipped.track("Probe").quaternion[::2] *= -1.0
    same_rotation(sampled(s)[2], sampled(flipped)[2], 1e-14)


@pytest.mark.parametrize(("last", "ticks"), [(0.1, 11), (0.0999, 10), (0.1001, 11), (0.3, 31), (0.0, 1)])
def test_the_input_ends_with_the_last_tick_not_after_the_last_sample(last: float, ticks: int) -> None:
    assert len(recording.tick_times(sequence(np.array([4.0, 4.0 + last])), 100.0)) == ticks


def test_a_single_sample_and_equal_times_are_played() -> None:
    assert sampled(sequence(np.array([3.0])))[1].tolist() == [[5.0, 6.0, 7.0]]
    s = sequence(np.array([0.0, 0.01, 0.01, 0.01]))
    assert np.isfinite(sampled(s)[1]).all()


def test_a_gap_is_invalid_except_within_half_a_tick_of_its_samples() -> None:
    """Samples at 0, 20, 63 and 83 ms, two frames lost between the middle ones: 30, 40 and 50 ms see nothing.

    20 ms is a sample itself; 60 ms is 3 ms from one.
    """
    s = sequence(np.array([0.0, 0.02, 0.063, 0.083]), number=[1, 2, 5, 6])
    assert sampled(s)[3].tolist() == [True, True, True, False, False, False, True, True, True]
    assert s.gaps == 1
    assert s.missing_frames == 2


def test_each_gap_of_two_ticks_is_lost_and_found_by_itself() -> None:
    """Also back to back: one sample between two gaps has a tick within half a tick, whatever the phase."""
    for phase in np.arange(0.0, 0.010, 0.0007):
        time = np.array([0.0, 0.02 + phase, 0.0403 + phase, 0.0606 + phase, 0.08 + phase, 0.1 + phase])
        s = sequence(time, number=[0, 1, 3, 5, 6, 7])
        valid = sampled(s)[3]
        assert np.count_nonzero(valid[:-1] & ~valid[1:]) == np.count_nonzero(~valid[:-1] & valid[1:]) == s.gaps == 2


def test_samples_that_are_not_ok_make_their_ticks_invalid_and_hold_the_pose() -> None:
    """Sample 2 of 0, 20, 40, 60 ms was not seen: no tick that it weighs in counts, 20 and 60 ms do."""
    s = sequence(np.arange(4) * 0.02, ok=[True, True, False, True])
    s.track("Probe").position[2] = 0.0
    _, position, _, valid = sampled(s)
    assert valid.tolist() == [True, True, True, False, False, False, True]
    np.testing.assert_array_equal(position[3:5], s.track("Probe").position[[1, 1]])


def test_a_sensor_is_held_at_its_first_sight_before_it() -> None:
    s = sequence(np.arange(4) * 0.02, ok=[False, False, True, True])
    _, position, _, valid = sampled(s)
    assert valid.tolist() == [False] * 4 + [True] * 3
    np.testing.assert_array_equal(position[0], s.track("Probe").position[2])


def test_home_anchors_each_instrument_and_keeps_its_motion(tmp_path: Path, task: Task, home: ToolPoses) -> None:
    """The first pose is home; what follows is the sensor's motion carried along rigidly.

    With sensor pose S(t), world_from_tool(t) = home S(0)⁻¹ S(t): relative motion home⁻¹ world(t) = S(0)⁻¹ S(t).
    Rounding: a dozen products of numbers below 200, 1e-11 at most.
    """
    s = sequence(np.arange(30) * 0.02)
    _, driver = open_driver(str(write(tmp_path / "a.igs.mha", s)), task, home, seed=0)
    played = drain(driver)
    first = Rigid(s.track("Probe").position[0], s.track("Probe").quaternion[0])
    time, position, quaternion, _ = sampled(s)
    assert len(played) == len(time)
    for k in range(2):
        np.testing.assert_allclose(played[0].position[k], home.position[k], rtol=0, atol=1e-11)
        same_rotation(played[0].quaternion[k], home.quaternion[k], 1e-11)
        for t in (1, 20, len(time) - 1):
            ours = home.world_from_tool(k).inverse() @ played[t].world_from_tool(k)
            wanted = first.inverse() @ Rigid(position[t], quaternion[t])
            np.testing.assert_allclose(ours.position, wanted.position, rtol=0, atol=1e-11)
            same_rotation(ours.quaternion, wanted.quaternion, 1e-11)


PROFILE = """
name = "mine"
driver = "recording"
summary = "test"
[recording]
path = "captures/a.igs.mha"
scale = 0.5
position_mm = [100.0, 0.0, -20.0]
rotation_deg = [0.0, 0.0, 90.0]
[[recording.sensor]]
name = "Probe"
tool = "right"
closure = 0.75
position_mm = [0.0, 4.0, 0.0]
rotation_deg = [180.0, 0.0, 0.0]
"""


def test_a_profile_maps_sensor_to_tool_step_by_step(tmp_path: Path, task: Task, home: ToolPoses) -> None:
    """world = Rz(90°) (p / 2 + R (0, 4, 0)) + (100, 0, -20), rotation Rz(90°) R Rx(180°), written out with matrices."""
    (tmp_path / "captures").mkdir()
    s = sequence(np.arange(30) * 0.02)
    write(tmp_path / "captures/a.igs.mha", s)
    profile = tmp_path / "mine.toml"
    profile.write_text(PROFILE)
    file, driver = open_driver(str(profile), task, home, seed=0)
    assert file.text == PROFILE
    played = drain(driver)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    _, position, quaternion, _ = sampled(s)
    right = [i.tool for i in task.scene.instrument].index("right")
    left = 1 - right
    for t, pose in enumerate(played):
        r = matrix_from_quaternion(quaternion[t])
        wanted = turn @ (0.5 * position[t] + r @ [0.0, 4.0, 0.0]) + [100.0, 0.0, -20.0]
        np.testing.assert_allclose(pose.position[right], wanted, rtol=0, atol=1e-11)
        ours = matrix_from_quaternion(pose.quaternion[right])
        np.testing.assert_allclose(ours, turn @ r @ np.diag([1.0, -1.0, -1.0]), rtol=0, atol=1e-11)
        assert pose.closure[right] == 0.75
        # the instrument without a sensor waits as the task says
        assert pose.position[left].tolist() == home.position[left].tolist()
        assert pose.closure[left] == home.closure[left]
        assert pose.valid[left]


def test_a_summary_counts_the_frames_that_were_played(tmp_path: Path, task: Task, home: ToolPoses) -> None:
    s = sequence(np.array([0.0, 0.02, 0.063, 0.083, 0.087]), number=[1, 2, 5, 6, 7])
    _, driver = open_driver(str(write(tmp_path / "a.igs.mha", s)), task, home, seed=0)
    assert driver.summary()["frames_consumed"] == 0
    driver.poll(3, None)  # 30 ms lies between the second and the third frame
    assert driver.summary()["frames_consumed"] == 3
    drain(driver)
    assert driver.summary() == {
        "driver": "recording",
        "path": str(tmp_path / "a.igs.mha"),
        "frames": 5,
        "frames_consumed": 5,
        "gaps": 1,
        "missing_frames": 2,
        "duration_s": pytest.approx(0.087, rel=1e-15),
        "sensors": {"right": "Probe", "left": "Stylus"},
    }


def test_a_recording_s_path_becomes_a_profile_whose_text_says_all(tmp_path: Path) -> None:
    path = str(put(tmp_path, 'odd "name" \\ é.seq.mha', SAMPLES[".igs.mha"][0]))
    file = open_profile(path)
    assert file.profile.name == "plus-sequence"
    assert file.profile.recording is not None
    assert file.profile.recording.path == path
    logged = open_profile("some where/sessions.db#20250101-x")
    assert logged.profile.recording is not None
    assert logged.profile.recording.path == "some where/sessions.db#20250101-x"


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (('"Probe"', '"Pointer"'), "no sensor 'Pointer'; it has Probe, Stylus"),
        (
            ("[[recording.sensor]]", '[[recording.sensor]]\nname="Stylus"\ntool="right"\n[[recording.sensor]]'),
            "maps two",
        ),
        (('path = "captures/a.igs.mha"', ""), "device 'mine' plays a recording: give its path"),
        (("captures/a", "captures/none"), "no such file"),
    ],
)
def test_a_profile_that_does_not_fit_is_one_line(
    tmp_path: Path, task: Task, home: ToolPoses, change: tuple[str, str], complaint: str
) -> None:
    (tmp_path / "captures").mkdir()
    write(tmp_path / "captures/a.igs.mha", sequence(np.arange(3) * 0.02))
    profile = tmp_path / "mine.toml"
    profile.write_text(PROFILE.replace(*change))
    with pytest.raises(ConfigError, match=complaint):
        open_driver(str(profile), task, home, seed=0)


def test_a_profile_without_sensors_or_with_one_never_seen_is_refused(
    tmp_path: Path, task: Task, home: ToolPoses
) -> None:
    blind = write(tmp_path / "blind.igs.mha", sequence(np.arange(2) * 0.02, ok=[False, False]))
    with pytest.raises(ConfigError, match="sensor 'Probe' is not OK in any frame"):
        open_driver(str(blind), task, home, seed=0)
    profile = tmp_path / "bare.toml"
    profile.write_text('name="bare"\ndriver="recording"\nsummary=""\n[recording]\npath = "blind.igs.mha"\n')
    with pytest.raises(ConfigError, match="the profile names no sensor"):
        open_driver(str(profile), task, home, seed=0)


@needs_real
def test_the_real_recording_is_played_whole(task: Task, home: ToolPoses) -> None:
    """Every one of the 614 gaps is one loss and one return, and the Probe's way is its own within 1 %.

    Linear interpolation keeps to the straight lines between samples, but a tick beside a sample cuts its corner.
    1 % is what the recording's users are promised; the ticks of 10 ms on a clock of 21 ms cost 0.3 % here.
    Unit length: the last operation divides by the norm, four roundings of 1.1e-16 each way.
    """
    _, driver = open_driver(str(REAL), task, home, seed=0)
    played = drain(driver)
    summary = driver.summary()
    assert (summary["frames"], summary["frames_consumed"], summary["gaps"]) == (5000, 5000, 614)
    valid = np.array([p.valid for p in played])
    assert (valid[:-1] & ~valid[1:]).sum(axis=0).tolist() == [614, 614]
    assert (~valid[:-1] & valid[1:]).sum(axis=0).tolist() == [614, 614]
    position = np.array([p.position for p in played])
    quaternion = np.array([p.quaternion for p in played])
    assert np.isfinite(position).all()
    np.testing.assert_allclose(np.linalg.norm(quaternion, axis=2), 1.0, rtol=0, atol=1e-15)
    rows = [
        line.split(b"=")[1].split() for line in REAL.read_bytes().splitlines() if b"_ProbeToTrackerTransform =" in line
    ]
    raw = np.array(rows, dtype=np.float64)[:, 3::4][:, :3]
    length = np.linalg.norm(np.diff(raw, axis=0), axis=1).sum()
    right = [i.tool for i in task.scene.instrument].index("right")
    ours = np.linalg.norm(np.diff(position[:, right], axis=0), axis=1).sum()
    assert ours == pytest.approx(length, rel=0.01)


@pytest.mark.parametrize("last", [90_000.0, 3e14, 1e300])
def test_times_that_are_no_seconds_are_one_line(last: float) -> None:
    with pytest.raises(ConfigError, match=r"lasts .* s; are its times in seconds\?"):
        recording.tick_times(sequence(np.array([0.0, last])), 100.0)
