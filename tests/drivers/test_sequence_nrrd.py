"""NRRD sequences: what their frames say is read, their pictures are passed by, and a bad header is one line."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from tests.drivers.format_samples import mha, nrrd, put
from trainer.config import ConfigError
from trainer.drivers import sequence_file, sequence_nrrd


def test_the_frames_say_the_same_in_both_image_formats(tmp_path: Path) -> None:
    a = sequence_nrrd.read(put(tmp_path, ".seq.nrrd", nrrd()))
    b = sequence_file.read(put(tmp_path, ".igs.mha", mha()))
    assert a.time.tolist() == b.time.tolist()
    assert a.frame_number.tolist() == b.frame_number.tolist()
    for sensor in ("Probe", "Stylus"):
        np.testing.assert_array_equal(a.track(sensor).position, b.track(sensor).position)
        np.testing.assert_array_equal(a.track(sensor).quaternion, b.track(sensor).quaternion)


@pytest.mark.parametrize("encoding", ["gz", "gzip", "bzip2", "raw"])
@pytest.mark.parametrize("pixels", [True, False])
def test_pictures_of_any_encoding_are_passed_by(tmp_path: Path, encoding: str, pixels: bool) -> None:
    assert len(sequence_nrrd.read(put(tmp_path, ".seq.nrrd", nrrd(4, encoding, pixels))).time) == 4


def test_the_axis_of_frames_is_found_by_its_kind(tmp_path: Path) -> None:
    """Slicer once put it first; without kinds it is the last."""
    content = nrrd(4, "gz").replace(b"sizes: 3 2 4", b"sizes: 4 3 2")
    first = content.replace(b"kinds: domain domain list", b"kinds: list domain domain")
    assert len(sequence_nrrd.read(put(tmp_path, ".nrrd", first)).time) == 4
    unnamed = nrrd(4, "gz").replace(b"kinds: domain domain list\n", b"")
    assert len(sequence_nrrd.read(put(tmp_path, ".nrrd", unnamed)).time) == 4


def test_line_ends_of_windows_and_pictures_in_another_file_are_read(tmp_path: Path) -> None:
    head = nrrd(4).split(b"\n\n")[0].replace(b"type:", b"data file: made.raw\ntype:") + b"\n\n"
    assert len(sequence_nrrd.read(put(tmp_path, ".nhdr.nrrd", head.replace(b"\n", b"\r\n"))).time) == 4


@pytest.mark.parametrize(
    ("pattern", "replacement", "complaint"),
    [
        (rb"\ANRRD", b"NRDD", "does not begin with 'NRRD000n'"),
        (rb"\n\n(.|\n)*", b"\n", "the header is cut short: no empty line"),
        (rb"endian: little", b"endian little", "line 5 is not 'key: value'"),
        (rb"sizes[^\n]*\n", b"", "the header has no 'sizes'"),
        (rb"sizes: 3", b"sizes: three", "'sizes' expected whole numbers"),
        (rb"sizes: 3 2 3", b"sizes: 3 2 6", "'sizes' says 6 frames, the header holds 3"),
        (rb"type: unsigned short", b"type: block", "unknown 'type: block'"),
        (rb".\Z", b"", "the pictures are cut short: 35 of 36 bytes"),
        (rb"Frame0002_Timestamp:=[^\n]*", b"Frame0002_Timestamp:=1", "frame 2: time goes back"),
    ],
)
def test_a_bad_file_is_one_line(tmp_path: Path, pattern: bytes, replacement: bytes, complaint: str) -> None:
    content, count = re.subn(pattern, replacement, nrrd())
    assert count
    path = put(tmp_path, ".seq.nrrd", content)
    with pytest.raises(ConfigError, match=complaint) as caught:
        sequence_nrrd.read(path)
    assert str(caught.value).startswith(f"{path}: ")
