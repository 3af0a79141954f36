"""Every format that we read: the same motion comes out, and a bad file is one clear line."""

from __future__ import annotations

import contextlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.drivers.format_samples import FRAMES, SAMPLES, pose, put
from trainer.config import ConfigError
from trainer.drivers import RECORDINGS, is_recording, motion_file
from trainer.geometry import matrix_from_quaternion
from trainer.motion import Motion

each_format = pytest.mark.parametrize("end", SAMPLES)
any_folder = settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])


def usable(motion: Motion) -> bool:
    """What a driver relies on: times in order, finite poses of unit length, arrays of one length."""
    n = len(motion.time)
    lengths = {len(motion.frame_number), *(len(t.ok) for t in motion.tracks.values())}
    return bool(
        lengths == {n}
        and n > 0
        and np.isfinite(motion.time).all()
        and (np.diff(motion.time) >= 0.0).all()
        and all(np.isfinite(t.position).all() for t in motion.tracks.values())
        and all(np.abs(np.linalg.norm(t.quaternion, axis=1) - 1.0).max() < 1e-9 for t in motion.tracks.values())
        and all(t.closure is None or np.isfinite(t.closure).all() for t in motion.tracks.values())
    )


@each_format
def test_the_same_motion_comes_out_of_every_format(end: str, tmp_path: Path) -> None:
    """Positions and rotations were written with 8 digits or more: 1e-7 of numbers up to 15 is 1.5e-6."""
    content, sensor = SAMPLES[end]
    motion = motion_file.read(put(tmp_path, end, content))
    track = motion.track(sensor)
    assert usable(motion)
    wanted = np.array([pose(k) for k in range(FRAMES)])
    own = slice(0, 2 * FRAMES, 2) if end == ".xml" else slice(None)  # two devices by turns
    np.testing.assert_allclose(track.position[own], wanted[:, :3, 3], rtol=0, atol=1.5e-6)
    np.testing.assert_allclose(matrix_from_quaternion(track.quaternion[own]), wanted[:, :3, :3], rtol=0, atol=1.5e-6)
    assert track.ok[own].all()


def test_what_can_be_read_is_a_recording_by_its_name() -> None:
    assert set(RECORDINGS) == set(motion_file.READERS)
    assert all(is_recording(f"a{end}") for end in motion_file.READERS)


def test_a_name_of_no_known_kind_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"made\.bag: no recording; expected a name that ends in \.mha"):
        motion_file.read(put(tmp_path, ".bag", b"x"))


@each_format
@pytest.mark.parametrize("content", [b"", b"\n", b"\x00\xff\xfe binary \x89", b"hello\n", b"<a/>\n", b"NRRD0004\n\n"])
def test_an_empty_or_foreign_file_is_one_line(end: str, content: bytes, tmp_path: Path) -> None:
    path = put(tmp_path, end, content)
    with pytest.raises(ConfigError) as caught:
        motion_file.read(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


@each_format
def test_a_missing_file_is_named(end: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such file"):
        motion_file.read(tmp_path / f"none{end}")


def read_or_complaint(path: Path) -> Motion | str:
    try:
        return motion_file.read(path)
    except ConfigError as error:
        return str(error)


def same_beginning(short: Motion, whole: Motion) -> bool:
    """Whether every sample of ``short`` that counts as seen is ``whole``'s at that time."""
    n = len(short.time)
    if not np.array_equal(short.time, whole.time[:n]):
        return False
    for name, track in short.tracks.items():
        of_whole = whole.tracks[name]
        seen = track.ok
        if not (
            np.array_equal(track.position[seen], of_whole.position[:n][seen])
            and np.array_equal(track.quaternion[seen], of_whole.quaternion[:n][seen])
            and (track.closure is None or np.array_equal(track.closure[seen], of_whole.closure[:n][seen]))  # type: ignore[index]
        ):
            return False
    return True


@each_format
def test_a_file_cut_anywhere_is_refused_in_one_line_or_read_as_its_beginning(end: str, tmp_path: Path) -> None:
    """Every length there is, so that no cut within a number passes for a whole one."""
    content, _ = SAMPLES[end]
    whole = motion_file.read(put(tmp_path, end, content))
    read = 0
    for length in range(len(content)):
        path = put(tmp_path, end, content[:length])
        short = read_or_complaint(path)
        if isinstance(short, str):
            assert short.startswith(f"{path}: ")
            assert "\n" not in short
        else:
            read += 1
            assert same_beginning(short, whole), length
    if end in (".txt", ".csv"):
        assert read >= FRAMES - 1  # lines that are whole are a recording


@each_format
@any_folder
@given(data=st.data())
def test_a_damaged_file_is_read_or_refused_never_a_traceback(end: str, tmp_path: Path, data: st.DataObject) -> None:
    content, _ = SAMPLES[end]
    at = data.draw(st.integers(0, len(content) - 1))
    new = data.draw(st.one_of(st.binary(max_size=6), st.sampled_from([b"1e300", b"nan", b"-inf", b'"', b"&x;", b"\n"])))
    over = data.draw(st.integers(0, 40))
    path = put(tmp_path, end, content[:at] + new + content[at + over :])
    with contextlib.suppress(ConfigError):
        assert usable(motion_file.read(path))
