"""Recorded motion as a PLUS/3D Slicer sequence file and as a tidy CSV table.

Numbers are written with as many digits as they need: what is read again (:mod:`trainer.drivers.motion_file`) is what
was written, bit for bit.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from trainer.exports.files import ExportError, new_file
from trainer.geometry import matrix_from_quaternion
from trainer.log.record import SessionRecord
from trainer.motion import Motion, Track

#: What PLUS writes above the frames of a recording without pictures.
HEADER = (
    "ObjectType = Image\nNDims = 3\nAnatomicalOrientation = RAI\nBinaryData = True\nBinaryDataByteOrderMSB = False\n"
    "CenterOfRotation = 0 0 0\nCompressedData = False\nDimSize = 0 0 {frames}\nKinds = domain domain list\n"
    "ElementSpacing = 1 1 1\nElementType = MET_UCHAR\nOffset = 0 0 0\nTransformMatrix = 1 0 0 0 1 0 0 0 1\n"
    "UltrasoundImageOrientation = MFA\n"
)

COLUMNS = (
    "frame", "time_s", "tool", "x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz", "closure", "jaw_angle_rad", "valid",
)  # fmt: skip


def of_session(record: SessionRecord) -> Motion:
    """A session's tool poses in the world's frame; the frame number is the tick."""
    tick = record.first_tick + np.arange(len(record.position), dtype=np.int64)
    tracks = {
        tool: Track(record.position[:, k], record.quaternion[:, k], record.valid[:, k], record.closure[:, k])
        for k, tool in enumerate(record.header.tools)
    }
    return Motion(f"session {record.header.id}", tick / record.header.tick_hz, tick, tracks)


def write_sequence(motion: Motion, path: Path) -> int:
    """Write an ``.igs.mha`` file; returns its frames. Raises ExportError where the file exists, OSError.

    A sensor without a reference in its name (``left``) gets one (``leftToReference``), as the format wants it. Raises
    ExportError also for a name that the format's keys cannot hold.
    """
    for name in motion.tracks:
        if not re.fullmatch(r"\w+", name):
            raise ExportError(f"{path}: a sequence file cannot name a sensor '{name}': letters and digits only")
    frames = [_sequence_frames(_with_reference(name), track) for name, track in motion.tracks.items()]
    with new_file(path) as file:
        file.write(HEADER.format(frames=len(motion.time)))
        for k, (time, number) in enumerate(zip(motion.time.tolist(), motion.frame_number.tolist(), strict=True)):
            for lines in frames:
                for field, value in next(lines):
                    file.write(f"Seq_Frame{k:04d}_{field} = {value}\n")
            file.write(f"Seq_Frame{k:04d}_FrameNumber = {number}\nSeq_Frame{k:04d}_Timestamp = {time!r}\n")
            file.write(f"Seq_Frame{k:04d}_ImageStatus = INVALID\n")
        file.write("ElementDataFile = LOCAL\n")
    return len(motion.time)


def _with_reference(name: str) -> str:
    return name if re.fullmatch(r".+To[A-Z]\w*", name) else f"{name}ToReference"


def _sequence_frames(name: str, track: Track) -> Iterator[list[tuple[str, str]]]:
    """Keys and values of one sensor, frame by frame. The quaternion tells what the matrix rounds."""
    matrix = np.tile(np.eye(4), (len(track.ok), 1, 1))
    matrix[:, :3, :3], matrix[:, :3, 3] = matrix_from_quaternion(track.quaternion), track.position
    jaws = [(f"{name}Closure", track.closure), (f"{name}JawAngle", track.jaw_angle)]
    for k in range(len(track.ok)):
        yield [
            (f"{name}Transform", " ".join(map(repr, matrix[k].ravel().tolist()))),
            (f"{name}TransformStatus", "OK" if track.ok[k] else "INVALID"),
            (f"{name}Quaternion", " ".join(map(repr, track.quaternion[k].tolist()))),
            *((field, repr(float(values[k]))) for field, values in jaws if values is not None),
        ]


def write_table(motion: Motion, path: Path) -> int:
    """Write a CSV table, a row a frame and tool; returns its rows. Raises ExportError where it exists, OSError."""
    with new_file(path) as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for k, (time, number) in enumerate(zip(motion.time.tolist(), motion.frame_number.tolist(), strict=True)):
            for tool, track in motion.tracks.items():
                pose = (*track.position[k].tolist(), *track.quaternion[k].tolist())
                jaws = ("" if values is None else float(values[k]) for values in (track.closure, track.jaw_angle))
                writer.writerow((number, time, tool, *pose, *jaws, int(track.ok[k])))
    return len(motion.time) * len(motion.tracks)


#: By the end of the file's name: how to write it.
WRITERS: dict[str, Callable[[Motion, Path], int]] = {".igs.mha": write_sequence, ".csv": write_table}
