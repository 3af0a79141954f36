"""What ``trainer devices calibrate`` does: files or a live device in, a dated calibration and its residuals out."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from trainer.drivers.calibrate import Readings, Sweep
    from trainer.drivers.watch import Watch
    from trainer.geometry import Array
    from trainer.profile import Profile, Sensor

LIVE = Path("live")
SWEEP_S = 15.0  # how long a live sweep lasts


def calibrate(
    reference: str, points: Path | None, sweep: Path | None, grid: Path | None, sensor: str | None, as_json: bool
) -> None:
    """Fit, write, tell. Raises ConfigError, CalibrationError."""
    from trainer import calibration
    from trainer.drivers import calibrate as fits
    from trainer.profile import load_profile, profile_path

    profile = load_profile(reference).profile
    chosen = fits.sensor_of(profile, sensor)
    if points is not None:
        fits.check_anchor(profile)  # before anybody has touched anything
    keep = profile_path(reference).with_suffix(f".readings-{datetime.now(UTC):%Y-%m-%dT%H%M%SZ}")
    measured = _measured(profile, chosen, points, sweep, grid, keep)
    found = fits.calibrate(profile, chosen, datetime.now(UTC).isoformat(timespec="seconds"), *measured)
    path = calibration.path_for(profile_path(reference), found)
    calibration.write(path, found)
    if profile.calibrated_by != "newest":
        typer.echo(f"trainer: the profile goes by '{profile.calibrated_by}', not by this one", err=True)
    if grid is not None and profile.calibration is not None:
        typer.echo("trainer: the field is corrected now; measure tips and points again", err=True)
    if as_json:
        print(json.dumps({"path": str(path), **asdict(found)}, indent=2))
        return
    field = found.distortion
    if grid is not None and field is not None:
        print(f"field: polynomial of order {field.order}, {field.points} points; residual on those held out of the fit")
        print(f"  {field.residual_before_mm:.3f} mm before, {field.residual_after_mm:.3f} mm after")
    for tip in found.tip if sweep is not None else ():
        place = ", ".join(f"{v:.2f}" for v in tip.position_mm)
        print(f"tip of {tip.sensor}: ({place}) mm, sd {tip.uncertainty_mm:.3f} mm, {tip.poses} poses")
        print(f"  residual {tip.residual_mm:.3f} mm")
    if points is not None and found.scene is not None:
        print(f"scene: {found.scene.points} points\n  residual {found.scene.residual_mm:.3f} mm")
    print(path)


def _measured(
    profile: Profile, sensor: Sensor, points: Path | None, sweep: Path | None, grid: Path | None, keep: Path
) -> tuple[Readings | None, Sweep | None, Readings | None]:
    """Readings at points, a sweep, and readings on a grid: from their files, or taken now from the device.

    Those that are taken now are written to ``keep`` with ``-points.csv`` and ``-grid.csv`` at its end.
    """
    from contextlib import ExitStack

    from trainer.drivers import calibrate as fits
    from trainer.drivers.watch import Watch

    to_touch, to_take = (None if path is None else fits.read_places(path) for path in (points, grid))
    with ExitStack() as stack:
        device = None
        if to_touch is not None or to_take is not None or sweep == LIVE:
            device = stack.enter_context(Watch(profile, SWEEP_S))
        place = None
        if grid is not None:
            place = (
                fits.read_readings(grid)
                if to_take is None
                else _touched(device, sensor, to_take, Path(f"{keep}-grid.csv"))
            )
        turned = None
        if sweep is not None:
            turned = fits.read_sweep(sweep, sensor.name) if sweep != LIVE else _swept(device, sensor)
        touched = None
        if points is not None:
            touched = (
                fits.read_readings(points)
                if to_touch is None
                else _touched(device, sensor, to_touch, Path(f"{keep}-points.csv"))
            )
    return touched, turned, place


def _touched(device: Watch | None, sensor: Sensor, places: Array, keep: Path) -> Readings:
    """The device's readings at each of ``places`` (n, 3) mm, one after the other, as somebody gets there.

    Each is written to ``keep`` at once, which ``--points`` or ``--grid`` reads again: a refusal later loses nothing.
    """
    import numpy as np

    from trainer.drivers.calibrate import KNOWN, READING, Readings
    from trainer.drivers.pose_table import QUATERNION

    assert device is not None
    keep.touch(exist_ok=False)
    position: list[Array] = []
    quaternion: list[Array] = []
    try:
        with keep.open("w", encoding="utf-8", newline="\n") as file:
            file.write(",".join((*READING, *QUATERNION, *KNOWN)) + "\n")
        typer.echo(f"trainer: readings are kept in {keep}", err=True)
        for k, place in enumerate(places.tolist(), 1):
            where = ", ".join(f"{v:g}" for v in place)
            p, q = _touch(device, sensor, f"{k} of {len(places)}: {sensor.name} to ({where}) mm")
            with keep.open("a", encoding="utf-8", newline="\n") as file:
                file.write(",".join(repr(float(v)) for v in (*p, *q, *place)) + "\n")
            position.append(p)
            quaternion.append(q)
    finally:
        if not position:  # given up before the first one
            keep.unlink()
    return Readings(np.array(position), np.array(quaternion), places)


def _touch(device: Watch, sensor: Sensor, what: str) -> tuple[Array, Array]:
    """Where the sensor is held, (3,) mm and (4,), once it is held still."""
    from trainer.calibration import CalibrationError

    while True:
        _wait_for(f"{what}, hold it still, then Enter")
        try:
            return device.touch(int(sensor.name.removeprefix("bird")))
        except CalibrationError as error:
            typer.echo(f"trainer: {error}; again", err=True)


def _swept(device: Watch | None, sensor: Sensor) -> Sweep:
    from trainer.drivers.calibrate import Sweep

    assert device is not None
    _wait_for(f"tip of {sensor.name} into its dimple; Enter, then tilt it to every side for {SWEEP_S:g} s")
    return Sweep(*device.poses(int(sensor.name.removeprefix("bird")), SWEEP_S))


def _wait_for(what: str) -> None:
    """Until Enter. Raises CalibrationError where nobody is there to press it."""
    from trainer.calibration import CalibrationError

    typer.echo(what, err=True)
    if not sys.stdin.readline():
        raise CalibrationError("the input ended before all was measured; no calibration is made")
