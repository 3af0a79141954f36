"""``trainer devices monitor`` on recordings: the numbers of its part, at the recording's own pace or at once."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.conftest import CommandLine

HEAD = "frame,time_s,tool,x_mm,y_mm,z_mm,qw,qx,qy,qz,closure,valid\n"
#: Both tools at 100 Hz for a second, frame 50 lost; right not seen in the second half.
ROWS = "".join(
    f"{k},{k / 100},{tool},{k},0,0,1,0,0,0,{k / 100},{int(tool == 'left' or k < 50)}\n"
    for k in range(101)
    if k != 50
    for tool in ("left", "right")
)


@pytest.fixture
def table(tmp_path: Path) -> Path:
    path = tmp_path / "poses.csv"
    path.write_text(HEAD + ROWS)
    return path


def test_all_of_a_recording_at_once(command_line: CommandLine, table: Path) -> None:
    code, out, err = command_line("devices", "monitor", table, "--json")
    assert (code, err) == (0, "")
    got = json.loads(out)
    assert (got["device"], got["calibration"], got["records"], got["lost"]) == ("pose-table", None, 100, 1)
    assert got["rate_hz"] == pytest.approx(99.0)
    assert got["sensors"]["left"] == {"tool": "left", "seen_percent": 100.0, "position_mm": [100, 0, 0], "closure": 1.0}
    assert got["sensors"]["right"]["seen_percent"] == 50.0
    assert got["sensors"]["right"]["position_mm"] == [49.0, 0.0, 0.0]


def test_only_the_first_seconds(command_line: CommandLine, table: Path) -> None:
    got = json.loads(command_line("devices", "monitor", table, "--json", "--seconds", "0.2")[1])
    assert (got["records"], got["lost"], got["sensors"]["right"]["seen_percent"]) == (21, 0, 100.0)


def test_the_table_says_the_same(command_line: CommandLine, table: Path) -> None:
    code, out, _ = command_line("devices", "monitor", table, "--seconds", "0.2")
    assert code == 0
    for text in ("pose-table", "left (left)", "100.0 Hz", "lost 0 (0.0 %)", "not calibrated", "20.00"):
        assert text in out


def test_the_age_of_the_calibration_is_told(command_line: CommandLine, table: Path, tmp_path: Path) -> None:
    sensor = '[[recording.sensor]]\nname = "left"\ntool = "left"\n'
    (tmp_path / "mine.toml").write_text(
        f'name = "mine"\ndriver = "recording"\nsummary = ""\n[recording]\npath = "{table.name}"\n{sensor}'
        '[calibration]\ndate = "2020-01-01T00:00:00+00:00"\n'
    )
    got = json.loads(command_line("devices", "monitor", tmp_path / "mine.toml", "--json")[1])
    assert got["calibration"]["date"] == "2020-01-01T00:00:00+00:00"
    assert got["calibration"]["age_s"] > 5 * 365 * 86400


@pytest.mark.parametrize(
    ("reference", "complaint"),
    [
        ("scripted-expert", "device 'scripted-expert' receives no records, so there is nothing to monitor"),
        ("openigtlink", "device 'openigtlink' cannot be monitored: only miniBIRDs and recordings can"),
        ("none.csv", "none.csv: no such file"),
        ("x.db#1", "receives no records"),
        ("plus-sequence", "give its path to --device, or 'recording.path'"),
    ],
)
def test_what_cannot_be_monitored_is_one_line(command_line: CommandLine, reference: str, complaint: str) -> None:
    code, out, err = command_line("devices", "monitor", reference)
    assert (code, out) == (1, "")
    assert complaint in err
    assert err.count("\n") == 1
