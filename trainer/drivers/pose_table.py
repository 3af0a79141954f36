"""Reader of tidy CSV tables of poses: one row a tool and time, as ``trainer export`` writes them.

Columns, in any order: ``time_s, tool, x_mm, y_mm, z_mm, qw, qx, qy, qz``, and where they are known ``closure``
(0 open … 1 closed), ``jaw_angle_rad``, ``valid`` (0: the tool was not seen) and ``frame`` or ``tick``, which jumps
where samples were lost. Other columns are passed by. Each tool may have times of its own.
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from trainer.config import ConfigError
from trainer.drivers.own_clocks import on_one_clock
from trainer.drivers.plausible import FARTHEST_MM, unit_quaternions
from trainer.drivers.text_lines import whole_lines
from trainer.geometry import Array
from trainer.motion import Motion, Track

POSITION = ("x_mm", "y_mm", "z_mm")
QUATERNION = ("qw", "qx", "qy", "qz")
REQUIRED = ("time_s", "tool", *POSITION, *QUATERNION)
SEEN = {"1": True, "true": True, "0": False, "false": False}

#: A row's cells by their columns' names, and its line in the file.
Row = tuple[dict[str, str], int]


def read(path: str | Path) -> Motion:
    """The recording in a table. Raises ConfigError, one line."""
    name = str(path)
    rows = read_rows(Path(path), REQUIRED)
    sessions = sorted({cells["session"] for cells, _ in rows if "session" in cells})
    if len(sessions) > 1:
        raise ConfigError(f"{name}: holds {len(sessions)} sessions ({', '.join(sessions)[:80]}); keep the rows of one")
    by_tool: dict[str, list[Row]] = {}
    for cells, line in rows:
        by_tool.setdefault(cells["tool"], []).append((cells, line))
    sampled = {tool: _track(own, name) for tool, own in by_tool.items()}
    motion = on_one_clock(name, sampled)
    counted = next((column for column in ("frame", "tick") if column in rows[0][0]), None)
    if counted is None:
        return motion
    return Motion(name, motion.time, _frame_numbers(by_tool, sampled, motion.time, counted, name), motion.tracks)


def read_rows(path: Path, required: tuple[str, ...]) -> list[Row]:
    """All rows of a CSV file that has the ``required`` columns, at least one. Raises ConfigError."""
    reader = csv.reader(line + "\n" for line in whole_lines(path))
    rows: list[Row] = []
    try:
        heading = [cell.strip() for cell in next(reader)]
        missing = [column for column in required if column not in heading]
        if missing:
            raise ConfigError(f"{path}: no column '{missing[0]}'; expected {', '.join(required)}")
        for cells in reader:
            if not cells:
                continue
            if len(cells) != len(heading):
                raise ConfigError(f"{path}: line {reader.line_num} has {len(cells)} of {len(heading)} cells")
            rows.append((dict(zip(heading, cells, strict=True)), reader.line_num))
    except csv.Error as error:
        raise ConfigError(f"{path}: line {reader.line_num}: {error}") from None
    if not rows:
        raise ConfigError(f"{path}: holds no row below its heading")
    return rows


def numbers(rows: list[Row], columns: tuple[str, ...], name: str, ok: np.ndarray | None = None) -> Array:
    """Finite numbers (n, columns); zeros where ``ok`` (n,) is false, whatever stands there. Raises ConfigError."""
    out = np.zeros((len(rows), len(columns)))
    for k in range(len(rows)) if ok is None else np.flatnonzero(ok).tolist():
        cells, line = rows[k]
        for i, column in enumerate(columns):
            try:
                out[k, i] = float(cells[column])
            except ValueError:
                found = cells[column][:40]
                raise ConfigError(f"{name}: line {line}: '{column}' expected a number, found '{found}'") from None
            if not abs(out[k, i]) <= np.finfo(np.float64).max:
                raise ConfigError(f"{name}: line {line}: '{column}' is not finite")
    return out


def _track(rows: list[Row], name: str) -> tuple[Array, Track]:
    time = numbers(rows, ("time_s",), name)[:, 0]
    back = np.flatnonzero(np.diff(time) < 0.0)
    if len(back):
        k = int(back[0])
        line = rows[k + 1][1]
        raise ConfigError(f"{name}: line {line}: time goes back from {time[k]:.6f} s to {time[k + 1]:.6f} s")
    ok = np.ones(len(rows), dtype=bool)
    if "valid" in rows[0][0]:
        for k, (cells, line) in enumerate(rows):
            if cells["valid"].strip().lower() not in SEEN:
                raise ConfigError(f"{name}: line {line}: 'valid' expected 0 or 1, found '{cells['valid'][:40]}'")
            ok[k] = SEEN[cells["valid"].strip().lower()]
    position = numbers(rows, POSITION, name, ok)
    far = (np.abs(position) > FARTHEST_MM).any(axis=1)
    if far.any():
        raise ConfigError(f"{name}: line {rows[int(np.argmax(far))][1]}: the position is farther than 1 km")
    quaternion = unit_quaternions(numbers(rows, QUATERNION, name, ok), ok, name, [f"line {line}" for _, line in rows])
    closure, angle = _jaws(rows, "closure", name), _jaws(rows, "jaw_angle_rad", name)
    return time, Track(position, quaternion, ok, closure, angle)


def _jaws(rows: list[Row], column: str, name: str) -> Array | None:
    """A tool's jaws (n,), or None where all its cells are empty or there is no such column."""
    if not any(cells.get(column) for cells, _ in rows):
        return None
    return numbers(rows, (column,), name)[:, 0]


def _frame_numbers(
    by_tool: dict[str, list[Row]], sampled: dict[str, tuple[Array, Track]], time: Array, column: str, name: str
) -> np.ndarray:
    """The frame number of each of the common times (n,), as the first tool that was sampled then has it."""
    counted: dict[str, Array] = {tool: numbers(rows, (column,), name)[:, 0] for tool, rows in by_tool.items()}
    for tool, number in counted.items():
        whole = (number == np.floor(number)) & (np.abs(number) < 2.0**53)
        if not whole.all():
            line = by_tool[tool][int(np.argmin(whole))][1]
            raise ConfigError(f"{name}: line {line}: '{column}' is not a whole number")
    for tool, (own, _) in sampled.items():
        if np.array_equal(own, time):
            return counted[tool].astype(np.int64)
    at: dict[float, float] = {}
    for tool, (own, _) in sampled.items():
        for t, number in zip(own.tolist(), counted[tool].tolist(), strict=True):
            at.setdefault(t, number)
    return np.array([at[t] for t in time.tolist()]).astype(np.int64)
