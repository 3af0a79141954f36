"""Reader of the transform logs of PerkTutor's Transform Recorder (XML).

Each ``<log type="transform">`` holds ``DeviceName``, ``TimeStampSec``, ``TimeStampNSec`` (in older logs ``time``, s)
and ``transform``, 16 numbers row by row in mm. A record appears when its device moves, so each device has times of its
own; ``<log type="message">`` and other elements are passed by.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from trainer.config import ConfigError
from trainer.drivers.own_clocks import on_one_clock
from trainer.drivers.plausible import FARTHEST_MM, is_rotation
from trainer.geometry import Array, quaternion_from_matrix
from trainer.motion import Motion, Track

#: Time and matrix of one record, and its place among all records of the file.
Record = tuple[float, list[float], int]


def read(path: str | Path) -> Motion:
    """The recording in a transform log; every record counts as seen. Raises ConfigError, one line."""
    name = str(path)
    found: dict[str, list[Record]] = {}
    try:
        with Path(path).open("rb") as file:
            place = 0
            for _, element in ElementTree.iterparse(file):
                if element.tag == "log" and element.get("type") == "transform":
                    place += 1
                    time, matrix = _seconds(element, name, place), _matrix(element, name, place)
                    found.setdefault(element.get("DeviceName") or "Unnamed", []).append((time, matrix, place))
                element.clear()
    except ElementTree.ParseError as error:
        line, column = error.position
        raise ConfigError(
            f"{name}: is cut short or no XML: line {line}, column {column}: {str(error).partition(':')[0]}"
        ) from None
    except ConfigError:
        raise
    except (LookupError, ValueError) as error:  # an encoding that nobody knows, or of several bytes a character
        raise ConfigError(f"{name}: its encoding cannot be read: {error}; save it as UTF-8") from None
    except OSError as error:
        raise ConfigError(f"{name}: {'no such file' if not Path(path).exists() else error.strerror}") from None
    if not found:
        raise ConfigError(f'{name}: holds no transform (no <log type="transform" …>)')
    return on_one_clock(name, {device: _track(records, name, device) for device, records in found.items()})


def _seconds(element: ElementTree.Element, name: str, place: int) -> float:
    """The time of a record: whole seconds and nanoseconds, as near as float64 comes, or the older ``time``."""
    if element.get("time") is not None:
        return _numbers(element, "time", 1, name, place)[0]
    (whole,) = _numbers(element, "TimeStampSec", 1, name, place)
    (part,) = _numbers(element, "TimeStampNSec", 1, name, place)
    return whole + 1e-9 * part


def _matrix(element: ElementTree.Element, name: str, place: int) -> list[float]:
    return _numbers(element, "transform", 16, name, place)


def _numbers(element: ElementTree.Element, key: str, count: int, name: str, place: int) -> list[float]:
    row = (element.get(key) or "").split()
    try:
        numbers = [float(text) for text in row]
    except ValueError:
        numbers = []
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise ConfigError(f"{name}: transform {place}: '{key}' expected {count} numbers, found '{' '.join(row)[:40]}'")
    return numbers


def _track(records: list[Record], name: str, device: str) -> tuple[Array, Track]:
    time = np.array([record[0] for record in records])
    back = np.flatnonzero(np.diff(time) < 0.0)
    if len(back):
        k = int(back[0])
        place = records[k + 1][2]
        raise ConfigError(f"{name}: transform {place}: time goes back from {time[k]:.6f} s to {time[k + 1]:.6f} s")
    matrix = np.array([record[1] for record in records]).reshape(-1, 4, 4)
    rigid = is_rotation(matrix[:, :3, :3]) & (matrix[:, 3] == [0.0, 0.0, 0.0, 1.0]).all(axis=1)
    rigid &= (np.abs(matrix[:, :3, 3]) <= FARTHEST_MM).all(axis=1)
    if not rigid.all():
        place = records[int(np.argmin(rigid))][2]
        raise ConfigError(f"{name}: transform {place}: that of '{device}' is not a rotation and a translation")
    quaternion = quaternion_from_matrix(matrix[:, :3, :3])
    return time, Track(matrix[:, :3, 3].copy(), quaternion, np.ones(len(time), dtype=bool))
