"""``trainer devices``: every shipped profile is listed and in order; a bad one is a line and exit code 1."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
from conftest import CommandLine
from typer.testing import CliRunner

from trainer import serial_ports
from trainer.cli.devices import app
from trainer.config import ConfigError
from trainer.profile import profile_names

REAL = Path(__file__).parents[3] / "shared/data/tracker/WaterTankBottomTranslationTrackerBuffer.igs.mha"

HEADER = "ObjectType = Image\nDimSize = 0 0 3\n"
FRAMES = "".join(
    f"Seq_Frame{k:04d}_TipToTrackerTransform = 1 0 0 {k} 0 1 0 0 0 0 1 0 0 0 0 1\n"
    f"Seq_Frame{k:04d}_FrameNumber = {2 * k}\nSeq_Frame{k:04d}_Timestamp = {k * k / 100}\n"
    for k in range(3)
)
RECORDING = f"{HEADER}{FRAMES}ElementDataFile = LOCAL\n"
PROFILE = """
name = "mine"
driver = "recording"
summary = "test"
[recording]
path = "a.igs.mha"
[[recording.sensor]]
name = "Tip"
tool = "left"
"""

runner = CliRunner()


def test_list_names_every_shipped_profile() -> None:
    got = runner.invoke(app, ["list", "--json"])
    assert got.exit_code == 0
    rows = json.loads(got.stdout)["profiles"]
    assert [row["name"] for row in rows] == profile_names()
    assert all(row["summary"] and row["driver"] for row in rows)
    table = runner.invoke(app, ["list"]).stdout.partition("\n\n")[0].splitlines()
    assert [line.split()[0] for line in table] == profile_names()


@pytest.mark.parametrize(
    ("vendor", "description", "fits", "what"),
    [
        (0x0403, "n/a", "minibird-pair: [minibird]", "FTDI adapter"),
        (0x2341, "Arduino Uno", "minibird-pair: [closure]", "Arduino Uno"),
        (0x1A86, None, "minibird-pair: [closure]", "CH340 of a board"),
        (None, "n/a", "minibird-pair: [minibird]", "serial port"),
        (0x9999, "Thing", "minibird-pair: [minibird] or [closure]", "Thing"),
    ],
)
def test_list_says_which_profile_fits_a_port(
    monkeypatch: pytest.MonkeyPatch, vendor: int | None, description: str | None, fits: str, what: str
) -> None:
    found = [SimpleNamespace(device=f"/dev/tty{k}", vid=vendor, description=description) for k in (1, 0)]
    monkeypatch.setattr(serial_ports.list_ports, "comports", lambda: found)
    ports = json.loads(runner.invoke(app, ["list", "--json"]).stdout)["ports"]
    assert ports == [{"port": f"/dev/tty{k}", "what": what, "fits": fits} for k in (0, 1)]
    for word in ("/dev/tty0", fits, what):
        assert word in runner.invoke(app, ["list"]).stdout.partition("\n\n")[2]


def test_no_port_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serial_ports.list_ports, "comports", list)
    below = runner.invoke(app, ["list"]).stdout.partition("\n\n")[2]
    assert below == "no serial port; plug a device in, or give its profile an address such as socket://host:port\n"


@pytest.mark.parametrize("name", profile_names())
def test_every_shipped_profile_is_in_order(name: str) -> None:
    got = runner.invoke(app, ["check", name])
    assert (got.exit_code, got.stdout) == (0, f"{name}: in order\n")


def test_check_says_what_a_recording_holds(tmp_path: Path) -> None:
    """Three samples 1 mm apart at 0, 10 and 40 ms, every second frame lost: intervals 10 and 30 ms."""
    path = tmp_path / "a.igs.mha"
    path.write_text(RECORDING)
    got = runner.invoke(app, ["check", str(path), "--json"])
    assert got.exit_code == 0
    recording = json.loads(got.stdout)["recording"]
    assert (recording["frames"], recording["gaps"], recording["missing_frames"]) == (3, 2, 2)
    assert recording["duration_s"] == pytest.approx(0.04)
    assert recording["interval_median_ms"] == pytest.approx(20.0)
    assert recording["interval_max_ms"] == pytest.approx(30.0)
    assert recording["sensors"] == {
        "Tip": {"frames_ok": 3, "low_mm": [0, 0, 0], "high_mm": [2, 0, 0], "path_length_mm": 2.0}
    }
    text = runner.invoke(app, ["check", str(path)]).stdout
    assert "3 frames, 0.04 s" in text
    assert "2 gaps, 2 missing frames" in text


def test_check_follows_a_profile_to_its_recording(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(PROFILE)
    (tmp_path / "a.igs.mha").write_text(RECORDING)
    assert "3 frames" in runner.invoke(app, ["check", str(tmp_path / "mine.toml")]).stdout


@pytest.mark.parametrize(
    ("name", "content", "complaint"),
    [
        ("a.igs.mha", HEADER + FRAMES, "the header is cut short"),
        ("none.igs.mha", "", "no such file"),
        ("mine.toml", PROFILE.replace("Tip", "Nib"), "no sensor 'Nib'; it has Tip"),
        ("mine.toml", PROFILE.replace("tool =", "tol ="), "unknown key 'tol', did you mean 'tool'?"),
        ("mine.toml", PROFILE.replace('"mine"', '"yours"'), "'name' must equal the file's name"),
        ("mine.toml", PROFILE.replace("a.igs", "b.igs"), "b.igs.mha: no such file"),
        ("none.db#1", "", "no log here"),
        ("unknown", "", "unknown device profile"),
    ],
)
@pytest.mark.parametrize("as_json", [False, True])
def test_a_problem_is_one_line_and_exit_code_1(
    tmp_path: Path, name: str, content: str, complaint: str, as_json: bool
) -> None:
    (tmp_path / "a.igs.mha").write_text(RECORDING)
    if content:
        (tmp_path / name).write_text(content)
    got = runner.invoke(app, ["check", str(tmp_path / name), *(["--json"] if as_json else [])])
    assert got.exit_code == 1
    if as_json:
        (problem,) = json.loads(got.stdout)["problems"]
    else:
        assert got.stdout == ""
        (problem,) = got.stderr.splitlines()
    assert complaint in problem


@pytest.mark.skipif(not REAL.exists(), reason=f"the real recording {REAL.name} is not beside the checkout")
def test_check_describes_the_real_recording() -> None:
    got = json.loads(runner.invoke(app, ["check", str(REAL), "--json"]).stdout)
    assert got["problems"] == []
    assert (got["recording"]["frames"], got["recording"]["gaps"]) == (5000, 614)
    assert list(got["recording"]["sensors"]) == ["Probe", "Reference", "Stylus"]


def test_a_simulation_does_not_overwrite_its_profile(tmp_path: Path) -> None:
    profile = tmp_path / "minibird-pair.toml"
    profile.write_text((Path(__file__).parents[2] / "devices" / "minibird-pair.toml").read_text())
    before = profile.read_text()
    got = runner.invoke(app, ["simulate", str(profile), "--out", str(tmp_path)])
    assert isinstance(got.exception, ConfigError)
    assert "is the profile itself; give --out another folder" in str(got.exception)
    assert profile.read_text() == before


def test_a_file_that_is_neither_profile_nor_recording_is_told_so(
    command_line: Callable[..., tuple[int, str, str]], tmp_path: Path
) -> None:
    path = tmp_path / "poses.dat"
    path.write_text("1 2 3\n", encoding="utf-8")
    code, out, err = command_line("devices", "check", path)
    assert (code, out) == (1, "")
    assert err.count("\n") == 1
    assert "neither a profile (.toml) nor a recording by its name (.mha, " in err


@pytest.mark.parametrize("there", ["flock", "closure"])
def test_a_simulation_leaves_alone_what_lies_where_its_ports_would_be(
    command_line: CommandLine, tmp_path: Path, there: str
) -> None:
    """Such as the ports of another simulation, which its programs are still talking to."""
    (tmp_path / there).write_text("somebody's")
    code, out, err = command_line("devices", "simulate", "minibird-pair", "--out", tmp_path)
    assert (code, out) == (1, "")
    assert err == f"trainer: {tmp_path / there}: is there already; another simulation plays there, or remove it\n"
    assert [path.name for path in tmp_path.iterdir()] == [there]
    assert (tmp_path / there).read_text() == "somebody's"
    code, _, err = command_line("devices", "simulate", "minibird-pair", "--out", tmp_path / there)
    assert (code, err.count("\n")) == (1, 1)
    assert "there is a file where a folder should be; give --out another name" in err
