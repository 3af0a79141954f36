"""What the frames of a PLUS/3D Slicer sequence say, whichever image format carries them.

The keys ``Seq_FrameNNNN_<Sensor>To<Reference>Transform`` hold 16 numbers, row by row, in mm, beside a
``…TransformStatus``, a ``Timestamp`` in s and a ``FrameNumber`` that jumps where the device lost frames.

Our own files also say ``<Sensor>To<Reference>Quaternion`` (wxyz), which a matrix gives back only to its last
digit, and ``…Closure`` (0 open … 1 closed) or ``…JawAngle`` (rad). Other programs pass such fields by.
"""

from __future__ import annotations

import math
import re

import numpy as np

from trainer.config import ConfigError
from trainer.drivers.plausible import FARTHEST_MM, ROTATION_TOLERANCE, is_rotation, unit_quaternions
from trainer.geometry import Array, matrix_from_quaternion, quaternion_from_matrix
from trainer.motion import Motion, Track

FRAME_KEY = re.compile(r"Seq_Frame([0-9]{1,9})_(\w+)")

#: Field name to {frame: text}.
Fields = dict[str, dict[int, str]]


def keep(fields: Fields, key: str, value: str) -> bool:
    """Put a header's line into ``fields`` when it belongs to a frame; whether it does."""
    match = FRAME_KEY.fullmatch(key)
    if match:
        fields.setdefault(match[2], {})[int(match[1])] = value
    return match is not None


def motion(fields: Fields, n: int, said_by: str, name: str) -> Motion:
    """The recording of ``n`` frames, as the header's ``said_by`` has it. Raises ConfigError, one line."""
    present = 1 + max((max(values) for values in fields.values()), default=-1)
    if present != n or n == 0:
        raise ConfigError(f"{name}: '{said_by}' says {n} frames, the header holds {present}")
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
    sensors = [key.removesuffix("Transform") for key in fields if key.endswith("Transform")]
    if not sensors:
        raise ConfigError(f"{name}: holds no sensor (no key Seq_FrameNNNN_<Sensor>To<Reference>Transform)")
    return Motion(name, time, frame_number, {sensor: _track(fields, sensor, n, name) for sensor in sensors})


def _numbers(fields: Fields, field: str, n: int, name: str) -> Array:
    """One number per frame, (n,)."""
    return _rows(fields, field, np.ones(n, dtype=bool), 1, name)[:, 0]


def _rows(fields: Fields, field: str, ok: np.ndarray, width: int, name: str) -> Array:
    """``width`` finite numbers for each frame that is ``ok``, (n, width); zeros for the others."""
    values = fields.get(field, {})
    out = np.zeros((len(ok), width))
    for k in np.flatnonzero(ok).tolist():
        row = values.get(k, "").split()
        if len(row) != width:
            what = f"'{field}' has {len(row)} of {width} numbers" if row else f"no '{field}'"
            raise ConfigError(f"{name}: frame {k}: {what}")
        try:
            out[k] = [float(number) for number in row]
        except ValueError:
            for number in row:
                _check_number(number, field, k, name)
    finite = np.isfinite(out).all(axis=1)
    if not finite.all():
        raise ConfigError(f"{name}: frame {np.argmin(finite)}: '{field}' is not finite")
    return out


def _track(fields: Fields, sensor: str, n: int, name: str) -> Track:
    """One sensor's poses; a frame without status counts as OK."""
    key = f"{sensor}Transform"
    status = fields.get(f"{key}Status", {})
    ok = np.array([status.get(k, "OK") == "OK" for k in range(n)])
    matrix = _rows(fields, key, ok, 16, name).reshape(n, 4, 4)
    matrix[~ok] = np.eye(4)
    rotation = matrix[:, :3, :3]
    rigid = is_rotation(rotation) & (matrix[:, 3] == [0.0, 0.0, 0.0, 1.0]).all(axis=1)
    rigid &= (np.abs(matrix[:, :3, 3]) <= FARTHEST_MM).all(axis=1)
    if not rigid.all():
        raise ConfigError(f"{name}: frame {np.argmin(rigid)}: '{key}' is not a rotation and a translation")
    quaternion = quaternion_from_matrix(rotation)
    if f"{sensor}Quaternion" in fields:
        rows = _rows(fields, f"{sensor}Quaternion", ok, 4, name)
        said = unit_quaternions(rows, ok, name, [f"frame {k}" for k in range(n)])
        other = np.abs(matrix_from_quaternion(said) - rotation).max(axis=(1, 2)) > ROTATION_TOLERANCE
        if other.any():
            raise ConfigError(f"{name}: frame {np.argmax(other)}: '{sensor}Quaternion' is not the rotation of '{key}'")
        quaternion = said
    # Jaws have a sensor of their own: they are known where the tracker saw nothing, too.
    closure, angle = (
        _numbers(fields, f"{sensor}{jaws}", n, name) if f"{sensor}{jaws}" in fields else None
        for jaws in ("Closure", "JawAngle")
    )
    return Track(matrix[:, :3, 3].copy(), quaternion, ok, closure, angle)


def _check_number(text: str, field: str, frame: int, name: str) -> None:
    try:
        value = float(text)
    except ValueError:
        raise ConfigError(f"{name}: frame {frame}: '{field}' expected a number, found '{text[:40]}'") from None
    if not math.isfinite(value):
        raise ConfigError(f"{name}: frame {frame}: '{field}' is not finite")
