"""Reader of JIGSAWS kinematics (Gao et al. 2014): text, one line of 76 numbers for each of 30 samples a second.

Four manipulators follow each other: the left and right master, the left and right slave. Each has 19 numbers: tip
position (m), rotation matrix row by row, velocity (m/s), rate of rotation (rad/s), gripper angle (rad). Velocities are
not read. The file holds no times; those of the original recordings are a thirtieth of a second apart.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from trainer.config import ConfigError
from trainer.drivers.plausible import FARTHEST_MM, is_rotation
from trainer.drivers.text_lines import whole_lines
from trainer.geometry import quaternion_from_matrix
from trainer.motion import Motion, Track

MANIPULATORS = ("MasterLeft", "MasterRight", "SlaveLeft", "SlaveRight")
NUMBERS = 19  # of each manipulator
SAMPLES_PER_S = 30.0
MM_PER_M = 1000.0


def read(path: str | Path) -> Motion:
    """The recording in a kinematics file; every sample counts as seen. Raises ConfigError, one line."""
    name = str(path)
    wanted = NUMBERS * len(MANIPULATORS)
    rows: dict[int, list[float]] = {}
    for number, line in enumerate(whole_lines(Path(path)), 1):
        row = line.split()
        if row and len(row) != wanted:
            raise ConfigError(f"{name}: line {number} has {len(row)} of {wanted} numbers; expected JIGSAWS kinematics")
        try:
            if row:
                rows[number] = [float(text) for text in row]
        except ValueError:
            raise ConfigError(f"{name}: line {number} is not all numbers; expected JIGSAWS kinematics") from None
    lines = list(rows)
    table = np.array(list(rows.values()))
    near = (np.abs(table) <= FARTHEST_MM / MM_PER_M).all(axis=1)
    if not near.all():
        raise ConfigError(f"{name}: line {lines[int(np.argmin(near))]}: a number is not finite or farther than 1 km")
    n = len(table)
    ok = np.ones(n, dtype=bool)
    tracks = {}
    for k, manipulator in enumerate(MANIPULATORS):
        block = table[:, NUMBERS * k : NUMBERS * (k + 1)]
        matrix = block[:, 3:12].reshape(n, 3, 3)
        rotation = is_rotation(matrix)
        if not rotation.all():
            at = lines[int(np.argmin(rotation))]
            raise ConfigError(f"{name}: line {at}: the matrix of {manipulator} is not a rotation")
        quaternion = quaternion_from_matrix(matrix)
        tracks[manipulator] = Track(MM_PER_M * block[:, 0:3], quaternion, ok, jaw_angle=block[:, 18].copy())
    return Motion(name, np.arange(n) / SAMPLES_PER_S, np.arange(n, dtype=np.int64), tracks)
