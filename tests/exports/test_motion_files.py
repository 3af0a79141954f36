"""What is written is read again bit for bit, in both formats; nothing is overwritten."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.drivers.format_samples import SAMPLES, put
from tests.metrics.synthetic_session import performed, task_of
from trainer.config import ConfigError
from trainer.drivers import motion_file, open_driver, open_profile
from trainer.exports.csv_files import write as write_csv
from trainer.exports.files import ExportError
from trainer.exports.motion_files import WRITERS, of_session, write_sequence, write_table
from trainer.geometry import Array, matrix_from_quaternion
from trainer.motion import Motion, Track
from trainer.poses import ToolPoses

REAL = Path(__file__).parents[3] / "shared/data/tracker/WaterTankBottomTranslationTrackerBuffer.igs.mha"
each_writer = pytest.mark.parametrize("end", WRITERS)


def same(a: Array | None, b: Array | None) -> bool:
    """Bit for bit: 0.0 is not -0.0."""
    return a is b or (a is not None and b is not None and a.tobytes() == b.tobytes())


def assert_same_motion(a: Motion, b: Motion) -> None:
    assert same(a.time, b.time)
    assert a.frame_number.tolist() == b.frame_number.tolist()
    assert len(a.tracks) == len(b.tracks)
    for x, y in zip(a.tracks.values(), b.tracks.values(), strict=True):
        assert x.ok.tolist() == y.ok.tolist()
        assert same(x.position[x.ok], y.position[y.ok])
        assert same(x.quaternion[x.ok], y.quaternion[y.ok])
        assert same(x.closure, y.closure)
        assert same(x.jaw_angle, y.jaw_angle)


@each_writer
@pytest.mark.parametrize("start", SAMPLES)
def test_a_recording_of_any_format_comes_back_exactly(end: str, start: str, tmp_path: Path) -> None:
    content, sensor = SAMPLES[start]
    motion = motion_file.read(put(tmp_path, start, content))
    path = tmp_path / f"again{end}"
    WRITERS[end](motion, path)
    again = motion_file.read(path)
    assert_same_motion(motion, again)
    again.track(sensor)  # found by its name


@st.composite
def motions(draw: st.DrawFn) -> Motion:
    """Poses with all their digits, times that may be equal, gaps, sensors with and without jaws, unseen samples."""
    n = draw(st.integers(1, 6))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    number = st.floats(-1e5, 1e5, allow_subnormal=True)
    tracks = {}
    for name in ("left", "ProbeToTracker"):
        quaternion = rng.normal(size=(n, 4))
        quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
        tracks[name] = Track(
            np.array(draw(st.lists(number, min_size=3 * n, max_size=3 * n))).reshape(n, 3),
            quaternion,
            np.array(draw(st.lists(st.booleans(), min_size=n, max_size=n))),
            rng.uniform(size=n) if draw(st.booleans()) else None,
            rng.normal(size=n) if draw(st.booleans()) else None,
        )
    time = np.sort(np.array(draw(st.lists(st.floats(0, 1e10), min_size=n, max_size=n))))
    return Motion("made", time, np.cumsum(rng.integers(0, 4, n)), tracks)


@each_writer
@settings(deadline=None, max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(motion=motions())
def test_any_motion_comes_back_bit_for_bit(end: str, tmp_path: Path, motion: Motion) -> None:
    path = tmp_path / f"any{end}"
    path.unlink(missing_ok=True)
    WRITERS[end](motion, path)
    assert_same_motion(motion, motion_file.read(path))


@each_writer
def test_a_session_comes_back_exactly(end: str, tmp_path: Path) -> None:
    session = performed(seed=3)
    motion = of_session(session)
    path = tmp_path / f"session{end}"
    WRITERS[end](motion, path)
    again = motion_file.read(path)
    assert_same_motion(motion, again)
    for k, tool in enumerate(session.header.tools):
        assert same(again.track(tool).position, np.ascontiguousarray(session.position[:, k]))
        assert same(again.track(tool).closure, np.ascontiguousarray(session.closure[:, k]))


def test_the_poses_that_the_csv_export_writes_are_a_recording(tmp_path: Path) -> None:
    session = performed(seed=4)
    write_csv([session], tmp_path / "out")
    assert_same_motion(of_session(session), motion_file.read(tmp_path / "out" / "poses.csv"))


def test_a_sequence_file_has_what_its_readers_look_for(tmp_path: Path) -> None:
    """Keys as PLUS writes them; a sensor's name has a reference; all 16 numbers of a pose; frames without pictures."""
    motion = of_session(performed(seed=5))
    n = write_sequence(motion, tmp_path / "a.igs.mha")
    text = (tmp_path / "a.igs.mha").read_text()
    assert f"DimSize = 0 0 {n}\n" in text
    assert text.endswith("ElementDataFile = LOCAL\n")
    for tool in ("left", "right"):
        rows = re.findall(rf"^Seq_Frame\d{{4}}_{tool}ToReferenceTransform = (.*)$", text, flags=re.MULTILINE)
        assert len(rows) == n
        assert {len(row.split()) for row in rows} == {16}
        assert text.count(f"_{tool}ToReferenceTransformStatus = OK") == n


@pytest.mark.parametrize("write", [write_sequence, write_table])
def test_nothing_is_overwritten(tmp_path: Path, write: Callable[[Motion, Path], int]) -> None:
    path = tmp_path / "a"
    path.write_text("mine")
    with pytest.raises(ExportError, match="exists already; nothing is overwritten"):
        write(of_session(performed()), path)
    assert path.read_text() == "mine"


def test_a_sensor_that_a_key_cannot_name_is_refused_and_kept_in_a_table(tmp_path: Path) -> None:
    text = "time_s,tool,x_mm,y_mm,z_mm,qw,qx,qy,qz\n0,left hand,1,2,3,1,0,0,0\n"
    motion = motion_file.read(put(tmp_path, ".csv", text.encode()))
    with pytest.raises(ExportError, match="cannot name a sensor 'left hand'"):
        write_sequence(motion, tmp_path / "a.igs.mha")
    assert not (tmp_path / "a.igs.mha").exists()
    write_table(motion, tmp_path / "a.csv")
    assert motion_file.read(tmp_path / "a.csv").sensors == ["left hand"]


@each_writer
def test_an_exported_session_moves_the_instruments_as_they_moved(end: str, tmp_path: Path) -> None:
    """Tick upon tick, jaws and what was not seen included; the names of its sensors say which is which.

    A tick's time and its sample's differ by the rounding of a time below 100 s, 1e-14, at speeds of 100 mm/s at most; a
    rotation passes a slerp and two products.
    """
    session = performed(seed=6)
    session.valid[7:9, 1] = False
    path = tmp_path / f"session{end}"
    WRITERS[end](of_session(session), path)
    task = task_of()
    tools = [instrument.tool for instrument in task.scene.instrument]
    waiting = ToolPoses(np.zeros((2, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)), np.zeros(2), np.ones(2, dtype=bool))
    _, driver = open_driver(str(path), task, waiting, seed=0)
    columns = [session.header.tools.index(tool) for tool in tools]
    played: list[ToolPoses] = []
    while (poses := driver.poll(len(played), None)) is not None:
        played.append(poses)
    seen = session.valid[:, columns]
    assert np.array_equal([poses.valid for poses in played], seen)
    position = np.array([poses.position for poses in played])
    turned = matrix_from_quaternion(np.array([poses.quaternion for poses in played]))
    closure = np.array([poses.closure for poses in played])
    np.testing.assert_allclose(position[seen], session.position[:, columns][seen], rtol=0, atol=1e-11)
    wanted = matrix_from_quaternion(session.quaternion[:, columns])
    np.testing.assert_allclose(turned[seen], wanted[seen], rtol=0, atol=1e-11)
    np.testing.assert_allclose(closure, session.closure[:, columns], rtol=0, atol=1e-11)


@each_writer
def test_an_instrument_that_a_file_does_not_have_stays_where_it_waits(end: str, tmp_path: Path) -> None:
    motion = of_session(performed(seed=6))
    path = tmp_path / f"right{end}"
    WRITERS[end](Motion("right", motion.time, motion.frame_number, {"right": motion.tracks["right"]}), path)
    task = task_of()
    tools = [instrument.tool for instrument in task.scene.instrument]
    waiting = ToolPoses(np.zeros((2, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)), np.zeros(2), np.ones(2, dtype=bool))
    _, driver = open_driver(str(path), task, waiting, seed=0)
    poses = driver.poll(0, None)
    assert poses is not None
    assert driver.summary()["sensors"] == {"right": "right"}
    assert poses.position[tools.index("left")].tolist() == [0.0, 0.0, 0.0]
    assert poses.position[tools.index("right")].any()


@each_writer
def test_a_file_written_again_is_played_by_the_names_of_its_sensors(end: str, tmp_path: Path) -> None:
    for start, player in ((".txt", "jigsaws"), (".igs.mha", "plus-sequence")):
        motion = motion_file.read(put(tmp_path, start, SAMPLES[start][0]))
        path = tmp_path / f"{player}{end}"
        WRITERS[end](motion, path)
        assert open_profile(str(path)).profile.name == player


@each_writer
def test_sensors_that_no_profile_knows_are_named_in_one_line(end: str, tmp_path: Path) -> None:
    motion = of_session(performed(seed=6))
    path = tmp_path / f"foreign{end}"
    WRITERS[end](
        Motion("x", motion.time, motion.frame_number, dict(zip("AB", motion.tracks.values(), strict=True))), path
    )
    with pytest.raises(ConfigError, match=r"which of its sensors \(A, B\) moves what\? Write a profile") as caught:
        open_profile(str(path))
    assert str(caught.value).startswith(f"{path}: ")


@pytest.mark.skipif(not REAL.exists(), reason=f"the real recording {REAL.name} is not beside the checkout")
@each_writer
def test_the_real_recording_comes_back_exactly(end: str, tmp_path: Path) -> None:
    motion = motion_file.read(REAL)
    path = tmp_path / f"real{end}"
    WRITERS[end](motion, path)
    again = motion_file.read(path)
    assert_same_motion(motion, again)
    assert (again.gaps, again.sensors) == (614, ["Probe", "Reference", "Stylus"])
