"""What was measured of a device where it stands: the tables of a calibration's dated file.

``trainer devices calibrate`` writes such a file beside the profile, ``NAME.calibration-DATE.toml``; loading the profile
puts the newest into effect, or the one that the profile names (:mod:`trainer.profile`). Its numbers are fitted in
:mod:`trainer.drivers.touched_points`, :mod:`trainer.drivers.pivot` and :mod:`trainer.drivers.field_distortion`.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

from trainer.config import ANGLE_DEG, POSITION_MM, Bounds, ConfigError

Vector = tuple[float, float, float]
RESIDUAL_MM = {"bounds": Bounds(0.0, 1e5)}


class CalibrationError(ValueError):
    """Measurements from which no calibration can be made; one line with the reason and what to do."""


@dataclass(frozen=True)
class Placement:
    """scene_from_device, from touched points."""

    position_mm: Vector = field(metadata=POSITION_MM)
    rotation_deg: Vector = field(metadata=ANGLE_DEG)  # about x, then y, then z
    residual_mm: float = field(metadata=RESIDUAL_MM)  # estimated error of a touch
    points: int


@dataclass(frozen=True)
class Tip:
    """Where the tip is, seen from a sensor, from a sweep about the resting tip."""

    sensor: str
    position_mm: Vector = field(metadata=POSITION_MM)  # sensor_from_tool
    residual_mm: float = field(metadata=RESIDUAL_MM)  # estimated error of a pose
    uncertainty_mm: float = field(metadata=RESIDUAL_MM)  # sd of the tip along its least certain axis
    poses: int


@dataclass(frozen=True)
class Distortion:
    """Correction of the positions of a bent field: position + polynomial of (position - centre) / half width."""

    order: int = field(metadata={"bounds": Bounds(1, 4)})
    centre_mm: Vector = field(metadata=POSITION_MM)
    half_width_mm: Vector = field(metadata={"bounds": Bounds(0.0, 1e5, low_open=True)})
    coefficient_mm: tuple[Vector, ...] = field(metadata=POSITION_MM)  # x y z of each of field_distortion.monomials
    residual_before_mm: float = field(metadata=RESIDUAL_MM)  # rms on points held out of the fit
    residual_after_mm: float = field(metadata=RESIDUAL_MM)
    points: int

    def __post_init__(self) -> None:
        n = self.order
        if len(self.coefficient_mm) != (n + 1) * (n + 2) * (n + 3) // 6:
            raise ValueError(f"'coefficient_mm' has {len(self.coefficient_mm)} rows, which order {n} does not have")


@dataclass(frozen=True)
class Calibration:
    """All that was measured of a device at one time; what was not is None or empty."""

    date: str  # UTC, ISO 8601
    scene: Placement | None = None
    tip: tuple[Tip, ...] = ()
    distortion: Distortion | None = None

    def __post_init__(self) -> None:
        try:
            datetime.fromisoformat(self.date)
        except ValueError:
            raise ValueError(f"'date' expected 2026-01-31T12:00:00+00:00, found '{self.date}'") from None

    def age_s(self, now: datetime) -> float:
        """Seconds from the calibration to ``now``, which has a time zone."""
        date = datetime.fromisoformat(self.date)
        return (now - (date if date.tzinfo else date.replace(tzinfo=UTC))).total_seconds()


def beside(profile: Path) -> list[Path]:
    """The calibrations of the profile in a file, oldest first."""
    start = f"{profile.stem}.calibration-"
    return sorted(p for p in profile.parent.iterdir() if p.name.startswith(start) and p.suffix == ".toml")


def path_for(profile: Path, calibration: Calibration) -> Path:
    """Where a calibration is written: beside its profile, named by the second of its date, UTC."""
    date = datetime.fromisoformat(calibration.date).astimezone(UTC)
    return profile.with_name(f"{profile.stem}.calibration-{date:%Y-%m-%dT%H%M%SZ}.toml")


def write(path: Path, calibration: Calibration) -> None:
    """Write a calibration's file. Raises ConfigError where there is one, OSError."""
    try:
        with path.open("x", encoding="utf-8", newline="\n") as file:
            file.write(to_toml(calibration))
    except FileExistsError:
        raise ConfigError(f"{path}: exists already; wait a second and calibrate again") from None


def to_toml(calibration: Calibration) -> str:
    """The text of a calibration's file; its numbers read back exactly."""
    lines = ["# Written by `trainer devices calibrate`.", "[calibration]", f'date = "{calibration.date}"']
    scene, distortion = calibration.scene, calibration.distortion
    if scene is not None:
        lines += ["", "[calibration.scene]", *_lines(vars(scene))]
    for tip in calibration.tip:
        lines += ["", "[[calibration.tip]]", *_lines(vars(tip))]
    if distortion is not None:
        lines += ["", "[calibration.distortion]", *_lines(vars(distortion))]
    return "\n".join(lines) + "\n"


def _lines(values: dict[str, object]) -> list[str]:
    return [f"{key} = {_value(value)}" for key, value in values.items()]


def _value(value: object) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(map(_value, value))}]"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace(
            "\x7f", "\\u007f"
        )  # the one that TOML escapes and JSON not
    return repr(value)
