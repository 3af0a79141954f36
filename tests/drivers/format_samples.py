"""Files of every format that we read, written from the formats' descriptions and by nothing of trainer's.

All hold the same motion: sensors that turn about z by 0.1 rad a sample and go along x by 1 mm a sample.
"""

from __future__ import annotations

import gzip
import math
from pathlib import Path

FRAMES = 3


def pose(k: int, aside: float = 0.0) -> list[list[float]]:
    """The 4 x 4 matrix of sample ``k``, mm; ``aside`` along y."""
    c, s = math.cos(0.1 * k), math.sin(0.1 * k)
    return [[c, -s, 0.0, 10.0 + k], [s, c, 0.0, 2.0 + aside], [0.0, 0.0, 1.0, 3.0], [0.0, 0.0, 0.0, 1.0]]


def sixteen(matrix: list[list[float]]) -> str:
    return " ".join(f"{v:.9g}" for row in matrix for v in row)


def jigsaws(frames: int = FRAMES) -> bytes:
    """76 columns: (x y z, R by rows, v, ω, gripper) of master left, master right, slave left, slave right; metres.

    Manipulator m is 5 m mm aside along y; the grippers open by 0.1 rad a sample, manipulator m from 0.2 m.
    """
    lines = []
    for k in range(frames):
        row: list[float] = []
        for m in range(4):
            a = pose(k, 5.0 * m)
            row += [a[0][3] / 1000, a[1][3] / 1000, a[2][3] / 1000]
            row += [a[i][j] for i in range(3) for j in range(3)]
            row += [0.03, 0.0, 0.0, 0.0, 0.0, 3.0, 0.2 * m + 0.1 * k]
        lines.append("   ".join(f"{v:.7e}" for v in row))
    return ("\n".join(lines) + "\n").encode()


def perktutor(frames: int = FRAMES) -> bytes:
    """Two devices, each recorded half a sample after the other, and a message between them; 20 ms a sample."""
    lines = ["<TransformRecorderLog>"]
    for k in range(frames):
        for device, late_ns in (("StylusToReference", 0), ("NeedleToReference", 10_000_000)):
            ns = 990_000_000 + 20_000_000 * k + late_ns
            lines.append(
                f'  <log TimeStampSec="{7 + ns // 1_000_000_000}" TimeStampNSec="{ns % 1_000_000_000}" '
                f'type="transform" DeviceName="{device}" transform="{sixteen(pose(k))} " />'
            )
        if k == 1:
            lines.append('  <log TimeStampSec="8" TimeStampNSec="5" type="message" message="Skin &amp; entry" />')
    return ("\n".join([*lines, "</TransformRecorderLog>"]) + "\n").encode()


def frame_lines(frames: int, between: str) -> list[str]:
    lines = []
    for k in range(frames):
        for sensor, aside in (("Probe", 0.0), ("Stylus", 5.0)):
            lines.append(f"Seq_Frame{k:04d}_{sensor}ToTrackerTransform{between}{sixteen(pose(k, aside))}")
            lines.append(f"Seq_Frame{k:04d}_{sensor}ToTrackerTransformStatus{between}OK")
        lines.append(f"Seq_Frame{k:04d}_FrameNumber{between}{100 + k}")
        lines.append(f"Seq_Frame{k:04d}_Timestamp{between}{7.99 + 0.02 * k:.6f}")
    return lines


def nrrd(frames: int = FRAMES, encoding: str = "raw", pixels: bool = True) -> bytes:
    """A NRRD sequence as PLUS writes it: 3 x 2 pictures of 2 bytes an element, raw or compressed."""
    sizes = f"3 2 {frames}" if pixels else f"0 0 {frames}"
    lines = [
        "NRRD0004",
        "# Complete NRRD file format specification at:",
        "dimension: 3",
        f"encoding: {encoding}",
        "endian: little",
        "kinds: domain domain list",
        f"sizes: {sizes}",
        "type: unsigned short",
        "ultrasound image orientation:=MF",
        *frame_lines(frames, ":="),
    ]
    payload = bytes(range(12)) * frames if pixels else b""
    if encoding in ("gz", "gzip"):
        payload = gzip.compress(payload, mtime=0)
    return ("\n".join(lines) + "\n\n").encode() + payload


def mha(frames: int = FRAMES) -> bytes:
    lines = ["ObjectType = Image", f"DimSize = 0 0 {frames}", "ElementType = MET_UCHAR", *frame_lines(frames, " = ")]
    return ("\n".join([*lines, "ElementDataFile = LOCAL"]) + "\n").encode()


def table(frames: int = FRAMES) -> bytes:
    """A tidy table: the tools left and right, seen always; jaws that close by a tenth a sample."""
    lines = ["frame,time_s,tool,x_mm,y_mm,z_mm,qw,qx,qy,qz,closure,valid"]
    for k in range(frames):
        for tool, aside in (("left", 0.0), ("right", 5.0)):
            a = pose(k, aside)
            q = f"{math.cos(0.05 * k):.9f},0,0,{math.sin(0.05 * k):.9f}"
            lines.append(f"{100 + k},{7.99 + 0.02 * k:.6f},{tool},{a[0][3]},{a[1][3]},{a[2][3]},{q},{0.1 * k:.3f},1")
    return ("\n".join(lines) + "\n").encode()


#: By the end of the file's name: a whole file, and a sensor that it holds.
SAMPLES: dict[str, tuple[bytes, str]] = {
    ".igs.mha": (mha(), "Probe"),
    ".seq.nrrd": (nrrd(), "Probe"),
    ".igs.nrrd": (nrrd(encoding="gz"), "Probe"),
    ".txt": (jigsaws(), "MasterLeft"),
    ".xml": (perktutor(), "Stylus"),
    ".csv": (table(), "left"),
}


def put(folder: Path, end: str, content: bytes) -> Path:
    path = folder / f"made{end}"
    path.write_bytes(content)
    return path
