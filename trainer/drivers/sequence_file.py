"""Reader of PLUS/3D Slicer sequence files with tracker transforms (``.igs.mha``, ``.seq.mha``).

Such a file is a MetaImage: text lines ``key = value`` up to ``ElementDataFile``, then the pictures. The keys
``Seq_FrameNNNN_<Sensor>To<Reference>Transform`` hold 16 numbers, row by row, in mm, beside a
``…TransformStatus``, a ``Timestamp`` in s and a ``FrameNumber`` that jumps where the device lost frames.
``DimSize`` ends with the number of frames; ``0 0 N`` is a file without pictures.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from trainer.config import ConfigError
from trainer.geometry import Array, quaternion_from_matrix

FRAME_KEY = re.compile(r"Seq_Frame([0-9]{1,9})_(\w+)")

ELEMENT_BYTES = {
    "MET_CHAR": 1, "MET_UCHAR": 1, "MET_SHORT": 2, "MET_USHORT": 2, "MET_INT": 4, "MET_UINT": 4, "MET_LONG": 4,
    "MET_ULONG": 4, "MET_LONG_LONG": 8, "MET_ULONG_LONG": 8, "MET_FLOAT": 4, "MET_DOUBLE": 8,
}  # fmt: skip

#: Largest entry of |RᵀR - I| that still is a rotation. Trackers send quaternions as 14-bit words, each wrong by
#: up to d = 1/8192, and a host may turn them into a matrix without scaling them to length 1: then
#: RᵀR - I = 4 [v]² (1 - |q|²), with |1 - |q|²| <= 2 d (|w| + |x| + |y| + |z|) <= 4 d. The 6 digits of the text
#: add 2 √3 · 5e-7.
ROTATION_TOLERANCE = 16 / 8192 + 2e-6


@dataclass(frozen=True)
class Track:
    """One sensor. Rows where the tracker did not see it hold no pose: zero and the identity."""

    position: Array  # (n, 3) mm, reference frame
    quaternion: Array  # (n, 4) wxyz, reference_from_sensor
    ok: np.ndarray  # (n,) bool


@dataclass(frozen=True)
class SequenceFile:
    """All sensors of a recording on their common, irregular clock."""

    path: str
    time: Array  # (n,) s, never decreasing
    frame_number: np.ndarray  # (n,) int64, as the device counted
    tracks: dict[str, Track]  # by "<Sensor>To<Reference>", in the order of the file

    @property
    def duration_s(self) -> float:
        return float(self.time[-1] - self.time[0])

    @property
    def gaps(self) -> int:
        """How often the device skipped frames."""
        return int(np.count_nonzero(np.diff(self.frame_number) > 1))

    @property
    def missing_frames(self) -> int:
        """How many frames the device skipped."""
        jumps = np.diff(self.frame_number)
        return int(np.sum(jumps[jumps > 1] - 1))

    @property
    def sensors(self) -> list[str]:
        """Names without the reference, or whole names where that would leave two alike."""
        short = [_short(name) for name in self.tracks]
        return [s if short.count(s) == 1 else name for s, name in zip(short, self.tracks, strict=True)]

    def track(self, sensor: str) -> Track:
        """The sensor ``Probe``, also called ``ProbeToTracker``. Raises ConfigError for one that is not there."""
        if sensor in self.tracks:
            return self.tracks[sensor]
        if sensor in self.sensors:
            return list(self.tracks.values())[self.sensors.index(sensor)]
        raise ConfigError(f"{self.path}: no sensor '{sensor}'; it has {', '.join(self.sensors)}")


def read(path: str | Path) -> SequenceFile:
    """The recording in a sequence file; the pictures are not read. Raises ConfigError, one line."""
    name = str(path)
    header, fields, data_bytes = _read_header(Path(path), name)
    n = _frame_count(header, fields, name)
    _check_pixels(header, data_bytes, name)
    time = _numbers(fields, "Timestamp", n, name)
    back = np.flatnonzero(np.diff(time) < 0.0)
    if len(back):
        k = int(back[0])
        raise ConfigError(f"{name}: frame {k + 1}: time goes back from {time[k]:.6f} s to {time[k + 1]:.6f} s")
    frame_number = np.arange(n, dtype=np.int64)
    if "FrameNumber" in fields:
        number = _numbers(fields, "FrameNumber", n, name)
        whole = (number == np.floor(number)) & (np.abs(number) < 2.0**53)
        if not whole.all():
            raise ConfigError(f"{name}: frame {np.argmin(whole)}: 'FrameNumber' is not a whole number")
        frame_number = number.astype(np.int64)
    tracks = {
        key.removesuffix("Transform"): _track(values, fields.get(f"{key}Status", {}), key, n, name)
        for key, values in fields.items()
        if key.endswith("Transform")
    }
    if not tracks:
        raise ConfigError(f"{name}: holds no sensor (no key Seq_FrameNNNN_<Sensor>To<Reference>Transform)")
    return SequenceFile(name, time, frame_number, tracks)


def describe(sequence: SequenceFile) -> dict[str, object]:
    """Size, clock, gaps and each sensor's range of motion, ready for JSON."""
    interval = 1e3 * np.diff(sequence.time) if len(sequence.time) > 1 else np.zeros(1)
    sensors: dict[str, object] = {}
    for name, track in zip(sequence.sensors, sequence.tracks.values(), strict=True):
        seen = track.position[track.ok]
        sensors[name] = {
            "frames_ok": len(seen),
            "low_mm": seen.min(axis=0).tolist() if len(seen) else None,
            "high_mm": seen.max(axis=0).tolist() if len(seen) else None,
            "path_length_mm": float(np.linalg.norm(np.diff(seen, axis=0), axis=1).sum()),
        }
    return {
        "frames": len(sequence.time),
        "duration_s": sequence.duration_s,
        "interval_median_ms": float(np.median(interval)),
        "interval_p99_ms": float(np.percentile(interval, 99)),
        "interval_max_ms": float(interval.max()),
        "gaps": sequence.gaps,
        "missing_frames": sequence.missing_frames,
        "sensors": sensors,
    }


def _short(name: str) -> str:
    match = re.fullmatch(r"(.+?)To[A-Z]\w*", name)
    return match[1] if match else name


def _read_header(path: Path, name: str) -> tuple[dict[str, str], dict[str, dict[int, str]], int]:
    """Header keys, the frames' keys as {field: {frame: text}}, and the number of bytes after the header."""
    header: dict[str, str] = {}
    fields: dict[str, dict[int, str]] = {}
    try:
        with path.open("rb") as file:
            for number, line in enumerate(file, 1):
                if not line.endswith(b"\n"):
                    break
                key, equals, value = line.decode("utf-8", "replace").partition("=")
                if not equals:
                    raise ConfigError(f"{name}: line {number} is not 'key = value'; expected a MetaImage sequence")
                key, value = key.strip(), value.strip()
                frame_key = FRAME_KEY.fullmatch(key)
                if frame_key:
                    fields.setdefault(frame_key[2], {})[int(frame_key[1])] = value
                    continue
                header[key] = value
                if key == "ElementDataFile":
                    return header, fields, path.stat().st_size - file.tell()
    except OSError as error:
        raise ConfigError(f"{name}: {'no such file' if not path.exists() else error.strerror}") from None
    raise ConfigError(f"{name}: the header is cut short: no line 'ElementDataFile = …' at its end; copy the file again")


def _frame_count(header: dict[str, str], fields: dict[str, dict[int, str]], name: str) -> int:
    n = _dimensions(header, name)[-1]
    present = 1 + max((max(values) for values in fields.values()), default=-1)
    if present != n or n == 0:
        raise ConfigError(f"{name}: 'DimSize' says {n} frames, the header holds {present}")
    return n


def _dimensions(header: dict[str, str], name: str) -> list[int]:
    try:
        sizes = [int(s) for s in header["DimSize"].split()]
    except KeyError:
        raise ConfigError(f"{name}: the header has no 'DimSize'") from None
    except ValueError:
        sizes = []
    if not sizes or min(sizes) < 0:
        raise ConfigError(f"{name}: 'DimSize' expected whole numbers, found '{header['DimSize']}'")
    return sizes


def _check_pixels(header: dict[str, str], data_bytes: int, name: str) -> None:
    """Compare the bytes behind the header with the pictures' size, where the header tells it.

    More bytes than needed are accepted: PLUS writes one for each frame of a recording without pictures.
    """
    elements = math.prod(_dimensions(header, name))
    if header["ElementDataFile"] != "LOCAL" or header.get("CompressedData", "False") == "True" or elements == 0:
        return
    kind = header.get("ElementType", "")
    channels = header.get("ElementNumberOfChannels", "1")
    if kind not in ELEMENT_BYTES or not channels.isdecimal():
        raise ConfigError(f"{name}: unknown 'ElementType = {kind}' of {channels} channels")
    expected = elements * ELEMENT_BYTES[kind] * int(channels)
    if data_bytes < expected:
        raise ConfigError(
            f"{name}: the pictures are cut short: {data_bytes} of {expected} bytes are there; copy the file again"
        )


def _numbers(fields: dict[str, dict[int, str]], field: str, n: int, name: str) -> Array:
    """One number per frame, (n,)."""
    values = fields.get(field, {})
    out = np.empty(n)
    for k in range(n):
        if k not in values:
            raise ConfigError(f"{name}: frame {k}: no '{field}'")
        out[k] = _float(values[k], field, k, name)
    return out


def _track(values: dict[int, str], status: dict[int, str], key: str, n: int, name: str) -> Track:
    """One sensor's poses; a frame without status counts as OK."""
    ok = np.array([status.get(k, "OK") == "OK" for k in range(n)])
    matrix = np.tile(np.eye(4), (n, 1, 1))
    for k in np.flatnonzero(ok).tolist():
        row = values.get(k, "").split()
        if len(row) != 16:
            what = f"'{key}' has {len(row)} of 16 numbers" if row else f"no '{key}'"
            raise ConfigError(f"{name}: frame {k}: {what}")
        try:
            matrix[k].flat = [float(number) for number in row]
        except ValueError:
            for number in row:
                _float(number, key, k, name)
    finite = np.isfinite(matrix).all(axis=(1, 2))
    if not finite.all():
        raise ConfigError(f"{name}: frame {np.argmin(finite)}: '{key}' is not finite")
    rotation = matrix[:, :3, :3]
    error = np.abs(rotation.transpose(0, 2, 1) @ rotation - np.eye(3)).max(axis=(1, 2))
    rigid = (error <= ROTATION_TOLERANCE) & (np.linalg.det(rotation) > 0.0)
    rigid &= (matrix[:, 3] == [0.0, 0.0, 0.0, 1.0]).all(axis=1)
    if not rigid.all():
        raise ConfigError(f"{name}: frame {np.argmin(rigid)}: '{key}' is not a rotation and a translation")
    return Track(matrix[:, :3, 3].copy(), quaternion_from_matrix(rotation), ok)


def _float(text: str, key: str, frame: int, name: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise ConfigError(f"{name}: frame {frame}: '{key}' expected a number, found '{text[:40]}'") from None
    if not math.isfinite(value):
        raise ConfigError(f"{name}: frame {frame}: '{key}' is not finite")
    return value
