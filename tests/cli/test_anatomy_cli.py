"""``trainer anatomy``: what it prints, and that a bad file or map is one line and exit code 1."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from trainer.anatomy import knee
from trainer.anatomy.label_volume import LabelVolume, write_nrrd

CommandLine = Callable[..., tuple[int, str, str]]
TRAINER_LABELS = Path(__file__).parents[2] / "trainer/anatomy/data/labels/trainer.toml"


@pytest.fixture(scope="module")
def volume() -> LabelVolume:
    return knee.build(knee.load("knee"), 1.5)


@pytest.fixture
def scan(volume: LabelVolume, tmp_path: Path) -> Path:
    path = tmp_path / "scan.nrrd"
    write_nrrd(volume, path)
    return path


def test_list_names_knees_maps_and_structures(command_line: CommandLine) -> None:
    code, out, _ = command_line("anatomy", "list", "--json")
    listed = json.loads(out)
    assert code == 0
    assert listed["built_in"] == ["knee"]
    assert set(listed["label_maps"]) == {"mskt", "trainer"}
    assert len(listed["structures"]) == 12
    lines = command_line("anatomy", "list")[1].splitlines()
    assert len(lines) == 1 + 2 + 12


def test_inspect_tells_axes_side_volumes_and_what_is_missing(
    scan: Path, volume: LabelVolume, command_line: CommandLine
) -> None:
    code, out, err = command_line("anatomy", "inspect", scan, "--json")
    found = json.loads(out)
    assert (code, err) == (0, "")
    assert (found["spacing_mm"], found["orientation"], found["side"]) == ([1.5, 1.5, 1.5], "LPS", "right")
    assert {row["label"]: row["volume_ml"] for row in found["labels"]} == pytest.approx(volume.volumes_ml())
    assert found["missing"] == []
    out = command_line("anatomy", "inspect", scan)[1]
    assert "side         right" in out
    assert "missing      nothing" in out


def test_import_writes_the_folder_and_says_what_is_in_it(scan: Path, tmp_path: Path, command_line: CommandLine) -> None:
    out_folder = tmp_path / "mine"
    code, out, err = command_line("anatomy", "import", scan, "--labels", TRAINER_LABELS, "--out", out_folder, "--json")
    assert (code, err) == (0, "")
    assert json.loads(out) == json.loads((out_folder / "anatomy.json").read_text())
    assert {path.name for path in out_folder.iterdir()} == {"anatomy.json", "labels.nrrd", "surfaces"}
    code, out, err = command_line("anatomy", "import", scan, "--labels", TRAINER_LABELS, "--out", out_folder)
    assert (code, out) == (1, "")
    assert err.startswith(f"trainer: {out_folder}: is there already")
    code, out, _ = command_line("anatomy", "import", scan, "--labels", "trainer", "--out", tmp_path / "other")
    assert code == 0
    assert "missing: nothing" in out


def test_what_is_wrong_is_one_line_and_exit_code_1(scan: Path, tmp_path: Path, command_line: CommandLine) -> None:
    labels = tmp_path / "labels.toml"
    labels.write_text('[labels]\n1 = "femur"\n77 = "tibia"\n')
    code, out, err = command_line("anatomy", "inspect", scan, "--labels", labels, "--json")
    assert code == 1
    assert err.count("\n") == 1
    assert f"{labels}: label 77 is not in {scan}" in err
    assert json.loads(out)["problems"] == [err.strip()]
    damaged = tmp_path / "damaged.nrrd"
    damaged.write_bytes(scan.read_bytes()[:-500])
    missing = tmp_path / "missing.toml"
    for arguments, message in (
        (("inspect", damaged), "cut short or damaged"),
        (("import", damaged, "--labels", TRAINER_LABELS, "--out", tmp_path / "x"), "cut short or damaged"),
        (("import", scan, "--labels", missing, "--out", tmp_path / "x"), "no such file, and no shipped label map"),
        (("import", scan, "--labels", labels, "--out", tmp_path / "x"), "label 77 is not in"),
    ):
        code, out, err = command_line("anatomy", *arguments)
        assert (code, out) == (1, "")
        assert err.startswith("trainer: ")
        assert message in err
        assert err.count("\n") == 1
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize("factor", [1e-3, 1e3], ids=["m for mm", "µm for mm"])
def test_a_scan_of_no_knees_size_is_refused(
    factor: float, volume: LabelVolume, tmp_path: Path, command_line: CommandLine
) -> None:
    """A factor of a thousand, at voxels of up to a metre, that the file's reader has to take as they are."""
    path = tmp_path / "scan.nrrd"
    spacing = tuple(factor / 1.5 * h for h in volume.spacing_mm)
    write_nrrd(LabelVolume(volume.labels, (spacing[0], spacing[1], spacing[2]), volume.lps_from_volume), path)
    for command in (("import", path, "--labels", TRAINER_LABELS, "--out", tmp_path / "x"), ("inspect", path)):
        code, _, err = command_line("anatomy", *command)
        assert code == 1
        assert "is not the size of a knee's scan, 20 to 1000 mm along each axis: is its spacing in mm?" in err
    assert not (tmp_path / "x").exists()


def test_an_empty_volume_is_told(volume: LabelVolume, tmp_path: Path, command_line: CommandLine) -> None:
    path = tmp_path / "empty.nrrd"
    write_nrrd(LabelVolume(np.zeros_like(volume.labels), volume.spacing_mm, volume.lps_from_volume), path)
    code, _, err = command_line("anatomy", "import", path, "--labels", TRAINER_LABELS, "--out", tmp_path / "x")
    assert code == 1
    assert "holds no label" in err
    assert command_line("anatomy", "inspect", path)[0] == 1
