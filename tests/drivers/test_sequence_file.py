"""Sequence files: what is read is what was written, and a bad file is one clear line."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from trainer.config import ConfigError
from trainer.drivers import sequence_file
from trainer.drivers.plausible import ROTATION_TOLERANCE
from trainer.geometry import matrix_from_quaternion, quaternion_from_axis_angle
from trainer.motion import describe

REAL = Path(__file__).parents[3] / "shared/data/tracker/WaterTankBottomTranslationTrackerBuffer.igs.mha"
needs_real = pytest.mark.skipif(not REAL.exists(), reason=f"the real recording {REAL.name} is not beside the checkout")

#: Three frames by hand, with what PLUS writes: a negative zero, a three-digit exponent, trailing blanks, CRLF.
BY_HAND = (
    b"ObjectType = Image\r\nNDims = 3\r\nCompressedData = False\r\nDimSize = 0 0 3    \r\nElementType = MET_UCHAR\r\n"
    b"Seq_Frame0000_FrameNumber = 7\r\n"
    b"Seq_Frame0000_ProbeToTrackerTransform = 0 -1 -0 1.5 1 9.14047e-005 0 -2 0 0 1 3 -0 0 -0 1 \r\n"
    b"Seq_Frame0000_ProbeToTrackerTransformStatus = OK\r\n"
    b"Seq_Frame0000_Timestamp = 10.5\r\n"
    b"Seq_Frame0001_FrameNumber = 8\r\n"
    b"Seq_Frame0001_ProbeToTrackerTransform = 1 0 0 1.6 0 1 0 -2 0 0 1 3 0 0 0 1\r\n"
    b"Seq_Frame0001_ProbeToTrackerTransformStatus = INVALID\r\n"
    b"Seq_Frame0001_Timestamp = 10.52\r\n"
    b"Seq_Frame0002_FrameNumber = 11\r\n"
    b"Seq_Frame0002_ProbeToTrackerTransform = 1 0 0 1.7 0 1 0 -2 0 0 1 3 0 0 0 1\r\n"
    b"Seq_Frame0002_Timestamp = 10.59\r\n"
    b"ElementDataFile = LOCAL\r\n"
)


def sequence_bytes(
    frames: int = 4, dim_size: str = "0 0 {n}", element_type: str = "MET_UCHAR", data: bytes = b""
) -> bytes:
    """A valid file: the sensors Probe and Stylus turn about z and move along x, 20 ms a frame."""
    lines = [
        "ObjectType = Image",
        "NDims = 3",
        f"DimSize = {dim_size.format(n=frames)}",
        f"ElementType = {element_type}",
    ]
    for k in range(frames):
        rotation = matrix_from_quaternion(quaternion_from_axis_angle([0, 0, 1], 0.1 * k))
        for sensor, x in (("Probe", 1.0 + k), ("Stylus", 50.0 - k)):
            rows = np.eye(4)
            rows[:3, :3], rows[:3, 3] = rotation, [x, 2.0, 3.0]
            numbers = " ".join(f"{v:.6g}" for v in rows.ravel())
            lines.append(f"Seq_Frame{k:04d}_{sensor}ToTrackerTransform = {numbers}")
            lines.append(f"Seq_Frame{k:04d}_{sensor}ToTrackerTransformStatus = OK")
        lines.append(f"Seq_Frame{k:04d}_FrameNumber = {100 + k}")
        lines.append(f"Seq_Frame{k:04d}_Timestamp = {5.0 + 0.02 * k:.6f}")
    lines.append("ElementDataFile = LOCAL")
    return "\n".join(lines).encode() + b"\n" + data


@pytest.fixture
def write(tmp_path: Path) -> Callable[[bytes], Path]:
    def write_bytes(content: bytes) -> Path:
        path = tmp_path / "made.igs.mha"
        path.write_bytes(content)
        return path

    return write_bytes


def test_a_file_written_by_hand_is_read_number_by_number(write: Callable[[bytes], Path]) -> None:
    got = sequence_file.read(write(BY_HAND))
    probe = got.track("Probe")
    assert got.time.tolist() == [10.5, 10.52, 10.59]
    assert got.frame_number.tolist() == [7, 8, 11]
    assert (got.gaps, got.missing_frames) == (1, 2)
    assert probe.ok.tolist() == [True, False, True]
    assert probe.position[[0, 2]].tolist() == [[1.5, -2.0, 3.0], [1.7, -2.0, 3.0]]
    # A quarter turn about z. The 9.14e-5 in the diagonal is a tracker's rounding: it moves q by half of that at most.
    np.testing.assert_allclose(probe.quaternion[0], [np.sqrt(0.5), 0, 0, np.sqrt(0.5)], atol=5e-5)
    assert got.sensors == ["Probe"]
    assert got.track("ProbeToTracker") is probe


@pytest.mark.parametrize("width", [1, 4, 7])
def test_frame_numbers_in_keys_have_any_width(write: Callable[[bytes], Path], width: int) -> None:
    text = re.sub(rb"Seq_Frame(\d+)", lambda m: b"Seq_Frame%0*d" % (width, int(m[1])), sequence_bytes(12))
    plain = sequence_file.read(write(sequence_bytes(12))).track("Probe").position
    assert np.array_equal(sequence_file.read(write(text)).track("Probe").position, plain)


def test_a_sensor_seen_in_two_frames_of_reference_is_named_whole(write: Callable[[bytes], Path]) -> None:
    got = sequence_file.read(write(sequence_bytes().replace(b"StylusToTracker", b"ProbeToReference")))
    assert got.sensors == ["ProbeToTracker", "ProbeToReference"]
    with pytest.raises(ConfigError, match="no sensor 'Probe'; it has ProbeToTracker, ProbeToReference"):
        got.track("Probe")


def test_pictures_are_counted_in_bytes_of_their_type(write: Callable[[bytes], Path]) -> None:
    """4 frames of 3 x 2 numbers of 2 bytes are 48 bytes; one less is cut short, more is padding."""
    for size in (48, 49):
        content = sequence_bytes(4, "3 2 {n}", "MET_SHORT", bytes(size))
        assert len(sequence_file.read(write(content)).time) == 4
    with pytest.raises(ConfigError, match="47 of 48 bytes"):
        sequence_file.read(write(sequence_bytes(4, "3 2 {n}", "MET_SHORT", bytes(47))))


def test_the_length_of_compressed_pictures_is_not_guessed(write: Callable[[bytes], Path]) -> None:
    content = sequence_bytes(4, "3 2 {n}", "MET_SHORT", b"zlib").replace(b"NDims", b"CompressedData = True\nNDims")
    assert len(sequence_file.read(write(content)).time) == 4


PROBE_1 = rb"(Seq_Frame0001_ProbeToTrackerTransform = )[^\n]*"


@pytest.mark.parametrize(
    ("pattern", "replacement", "complaint"),
    [
        (rb"ElementDataFile[^$]*", b"", "the header is cut short"),
        (rb"ElementDataFile = LOCAL\n", b"ElementDataFile = LOC", "the header is cut short"),
        (rb"\A[^$]*\Z", b"", "the header is cut short"),
        (rb"NDims = 3", b"\x89PNG", "line 2 is not 'key = value'"),
        (rb"DimSize = [^\n]*\n", b"", "no 'DimSize'"),
        (rb"DimSize = [^\n]*", b"DimSize = 0 0 many", "'DimSize' expected whole numbers"),
        (rb"DimSize = [^\n]*", b"DimSize = 0 0 9", "'DimSize' says 9 frames, the header holds 4"),
        (rb"DimSize = [^\n]*", b"DimSize = 0 0 3", "'DimSize' says 3 frames, the header holds 4"),
        (rb"DimSize = [^\n]*\nElementType = \w+", b"DimSize = 1 1 4\nElementType = MET_ODD", "unknown 'ElementType"),
        (rb"Seq_Frame0003[^\n]*\n", b"", "'DimSize' says 4 frames, the header holds 3"),
        (PROBE_1 + rb"\n", b"", "frame 1: no 'ProbeToTrackerTransform'"),
        (PROBE_1, rb"\1 1 0 0", "frame 1: 'ProbeToTrackerTransform' has 3 of 16 numbers"),
        (PROBE_1, rb"\1 1 0 0 x 0 1 0 0 0 0 1 0 0 0 0 1", "frame 1: 'ProbeToTrackerTransform' expected a number"),
        (PROBE_1, rb"\1 1 0 0 nan 0 1 0 0 0 0 1 0 0 0 0 1", "frame 1: 'ProbeToTrackerTransform' is not finite"),
        (PROBE_1, rb"\1 1 0 0 -inf 0 1 0 0 0 0 1 0 0 0 0 1", "frame 1: 'ProbeToTrackerTransform' is not finite"),
        (PROBE_1, rb"\1 1.01 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1", "frame 1: .* is not a rotation"),
        (PROBE_1, rb"\1 -1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1", "frame 1: .* is not a rotation"),  # a reflection
        (PROBE_1, rb"\1 1 0 0 0 0 1 0 0 0 0 1 0 0 0 5 1", "frame 1: .* is not a rotation"),
        (rb"(Frame0002_Timestamp) = [^\n]*", rb"\1 = 5.0", "frame 2: time goes back from 5.020000 s to 5.000000 s"),
        (rb"(Frame0002_Timestamp) = [^\n]*", rb"\1 = nan", "frame 2: 'Timestamp' is not finite"),
        (rb"(Frame0002_Timestamp) = [^\n]*", rb"\1 = soon", "frame 2: 'Timestamp' expected a number"),
        (rb"Seq_Frame0002_Timestamp[^\n]*\n", b"", "frame 2: no 'Timestamp'"),
        (rb"(Frame0002_FrameNumber) = [^\n]*", rb"\1 = 1.5", "frame 2: 'FrameNumber' is not a whole number"),
        (rb"Seq_Frame\d+_\w+Transform(Status)? = [^\n]*\n", b"", "holds no sensor"),
    ],
)
def test_a_bad_file_is_one_line_that_names_it(
    write: Callable[[bytes], Path], pattern: bytes, replacement: bytes, complaint: str
) -> None:
    content, count = re.subn(pattern, replacement, sequence_bytes())
    assert count > 0
    path = write(content)
    with pytest.raises(ConfigError, match=complaint) as caught:
        sequence_file.read(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_a_missing_file_a_folder_and_a_missing_sensor_are_named(write: Callable[[bytes], Path], tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.igs\.mha: no such file"):
        sequence_file.read(tmp_path / "none.igs.mha")
    with pytest.raises(ConfigError, match=re.escape(f"{tmp_path}: Is a directory")):
        sequence_file.read(tmp_path)
    with pytest.raises(ConfigError, match="no sensor 'Pointer'; it has Probe, Stylus"):
        sequence_file.read(write(sequence_bytes())).track("Pointer")


def test_a_frame_that_was_not_seen_may_hold_anything(write: Callable[[bytes], Path]) -> None:
    """Trackers leave zeros, NaN or nothing where they saw nothing; the rest of the file stays readable."""
    for garbage in (b"0 " * 16, b"nan " * 16, b""):
        content = re.sub(PROBE_1, rb"\g<1>" + garbage, sequence_bytes())
        content = content.replace(
            b"0001_ProbeToTrackerTransformStatus = OK", b"0001_ProbeToTrackerTransformStatus = MISSING"
        )
        probe = sequence_file.read(write(content)).track("Probe")
        assert probe.ok.tolist() == [True, False, True, True]
        assert np.isfinite(probe.position).all()
        assert np.isfinite(probe.quaternion).all()


def test_rotations_of_a_14_bit_tracker_pass() -> None:
    """The tolerance's own argument: q truncated to multiples of 1/8192 and not scaled, in 6 digits, is a rotation."""
    rng = np.random.default_rng(1)
    q = rng.normal(size=(20000, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    r = np.vectorize(lambda v: float(f"{v:.6g}"))(matrix_from_quaternion(np.floor(q * 8192) / 8192))
    error = np.abs(r.transpose(0, 2, 1) @ r - np.eye(3)).max()
    assert 0.2 * ROTATION_TOLERANCE < error < ROTATION_TOLERANCE


FUZZED = sequence_bytes(4, "3 2 {n}", "MET_SHORT", bytes(48))


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(length=st.integers(0, len(FUZZED)))
def test_a_file_cut_anywhere_is_refused_clearly(tmp_path: Path, length: int) -> None:
    path = tmp_path / "cut.igs.mha"
    path.write_bytes(FUZZED[:length])
    if length == len(FUZZED):
        assert len(sequence_file.read(path).time) == 4
    else:
        with pytest.raises(ConfigError, match="cut short"):
            sequence_file.read(path)


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(at=st.integers(0, len(FUZZED) - 1), new=st.binary(max_size=6), over=st.integers(0, 40))
def test_a_damaged_file_is_read_or_refused_never_a_traceback(tmp_path: Path, at: int, new: bytes, over: int) -> None:
    path = tmp_path / "damaged.igs.mha"
    path.write_bytes(FUZZED[:at] + new + FUZZED[at + over :])
    with contextlib.suppress(ConfigError):
        got = sequence_file.read(path)
        assert np.isfinite(got.time).all()
        assert all(np.isfinite(t.position).all() and np.isfinite(t.quaternion).all() for t in got.tracks.values())


@needs_real
def test_the_real_recording_holds_what_an_independent_reading_finds() -> None:
    """Counts by regular expression; positions lie on the tracker's grid of 36 in / 8192, to the text's 6 digits."""
    text = REAL.read_bytes().decode("latin-1")
    got = sequence_file.read(REAL)
    number = np.array([int(v) for v in re.findall(r"_FrameNumber = (\d+)", text)])
    assert len(got.time) == len(number) == 5000
    assert got.gaps == np.count_nonzero(number[1:] != number[:-1] + 1) == 614
    for sensor in ("Probe", "Reference", "Stylus"):
        found = re.findall(rf"_{sensor}ToTrackerTransform = ([^\n]*)", text)
        position = np.array([row.split() for row in found], dtype=np.float64)[:, [3, 7, 11]]
        track = got.track(sensor)
        length = np.sqrt(((position[1:] - position[:-1]) ** 2).sum(axis=1)).sum()
        ours = describe(got)["sensors"][sensor]["path_length_mm"]  # type: ignore[index]
        assert ours == pytest.approx(length, rel=1e-9)
        step = 36 * 25.4 / 8192
        off_grid = np.abs(track.position / step - np.round(track.position / step)) * step
        assert off_grid.max() <= 5.001e-4  # half a unit of the sixth digit of a three-digit position
        assert track.ok.all()


@needs_real
def test_the_real_recording_cut_in_its_header_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "cut.igs.mha"
    path.write_bytes(REAL.read_bytes()[:2_000_000])
    with pytest.raises(ConfigError, match="the header is cut short"):
        sequence_file.read(path)
