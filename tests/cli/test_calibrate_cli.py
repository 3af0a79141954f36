"""``trainer devices calibrate``: files in, residuals and a dated file beside the profile out; refusals are one line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import CommandLine
from tests.drivers.test_calibrate import GRID, PHANTOM, TOML, Readings, recorded, sweep, table, touch
from trainer.drivers.calibrate import mapping
from trainer.profile import load_profile


@pytest.fixture
def station(tmp_path: Path) -> Path:
    """A folder with a profile and what was measured with it."""
    rng = np.random.default_rng(0)
    (tmp_path / "mine.toml").write_text(TOML)
    (tmp_path / "points.csv").write_text(table(touch(PHANTOM, rng), oriented=True))
    (tmp_path / "sweep.csv").write_text(recorded(sweep(rng)))
    bent = Readings(GRID * [1.0, 1.03, 1.0], np.zeros((len(GRID), 4)), GRID)
    (tmp_path / "grid.csv").write_text(table(bent, oriented=False))
    line = Readings(PHANTOM * [1, 0, 0], np.zeros((len(PHANTOM), 4)), PHANTOM * [1, 0, 0])
    (tmp_path / "line.csv").write_text(table(line, oriented=False))
    return tmp_path


def test_tip_and_points_are_fitted_and_kept(command_line: CommandLine, station: Path) -> None:
    code, out, err = command_line(
        "devices",
        "calibrate",
        station / "mine.toml",
        "--points",
        station / "points.csv",
        "--sweep",
        station / "sweep.csv",
    )
    assert (code, err) == (0, "")
    assert "tip of Bird: (2.00, -1.00, 90.00) mm, sd 0.000 mm, 300 poses\n  residual 0.000 mm" in out
    assert "scene: 12 points\n  residual 0.000 mm" in out
    (kept,) = station.glob("mine.calibration-*.toml")
    assert out.splitlines()[-1] == str(kept)
    assert "[calibration.scene]" in kept.read_text()


def test_a_grid_says_what_it_helped_on_points_held_out(command_line: CommandLine, station: Path) -> None:
    code, out, _ = command_line("devices", "calibrate", station / "mine.toml", "--grid", station / "grid.csv", "--json")
    assert code == 0
    got = json.loads(out)
    assert Path(got["path"]).exists()
    assert got["distortion"]["residual_after_mm"] < 1e-9 < 0.5 < got["distortion"]["residual_before_mm"]


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ([], "nothing was measured; give --points, --sweep or --grid"),
        (["--points", "line.csv"], "the points lie on a line"),
        (["--points", "none.csv"], "none.csv: no such file"),
        (["--sweep", "points.csv"], "points.csv: no column 'time_s'"),
        (["--points", "points.csv", "--sensor", "Boat"], "no sensor 'Boat'; it has Bird"),
    ],
)
def test_a_refusal_is_one_line_and_nothing_is_kept(
    command_line: CommandLine, station: Path, arguments: list[str], complaint: str
) -> None:
    given = [station / a if a.endswith(".csv") else a for a in arguments]
    code, out, err = command_line("devices", "calibrate", station / "mine.toml", *given)
    assert (code, out) == (1, "")
    assert complaint in err
    assert err.count("\n") == 1
    assert not list(station.glob("mine.calibration-*"))


def test_a_profile_that_goes_by_another_calibration_is_told(command_line: CommandLine, station: Path) -> None:
    (station / "mine.toml").write_text(f'calibrated_by = "none"\n{TOML}')
    _, _, err = command_line("devices", "calibrate", station / "mine.toml", "--sweep", station / "sweep.csv")
    assert "the profile goes by 'none', not by this one" in err


@pytest.mark.parametrize("device", ["openigtlink", "ndi-aurora"])
def test_touched_points_calibrate_every_device_that_tells_poses(
    command_line: CommandLine, station: Path, device: str
) -> None:
    """Readings from a file tell where the scene is, and the profile goes by it from then on."""
    text = load_profile(device).text.replace('anchor = "home"', 'anchor = "none"').replace("scale = 0.1", "scale = 1.0")
    mine = station / f"{device}.toml"
    mine.write_text(text)
    name = mapping(load_profile(device).profile).sensor[0].name
    turned = station / "sweep.csv"
    turned.write_text(turned.read_text().replace("Bird", name))
    files = ("--points", station / "points.csv", "--sweep", turned)
    code, out, err = command_line("devices", "calibrate", mine, "--sensor", name, *files, "--json")
    assert code == 0, err
    found = load_profile(str(mine)).profile
    placed = found.openigtlink or found.ndi
    assert placed is not None
    assert list(placed.position_mm) == json.loads(out)["scene"]["position_mm"]
