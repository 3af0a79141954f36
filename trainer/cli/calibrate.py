"""What ``trainer devices calibrate`` does: files in, a dated calibration beside the profile and its residuals out."""

from __future__ import annotations

import json
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path

import typer


def calibrate_from_files(
    reference: str, points: Path | None, sweep: Path | None, grid: Path | None, sensor: str | None, as_json: bool
) -> None:
    """Fit, write, tell. Raises ConfigError, CalibrationError."""
    from trainer import calibration
    from trainer.drivers.calibrate import from_files
    from trainer.profile import load_profile, profile_path

    profile = load_profile(reference).profile
    found = from_files(profile, datetime.now(UTC).isoformat(timespec="seconds"), sensor, points, sweep, grid)
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
