"""``trainer practice --anatomy``: another knee than the task's, its replay, and what is said where it is not there."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from trainer.anatomy import imported, library
from trainer.anatomy.label_volume import LabelVolume, write_nrrd
from trainer.anatomy.structures import number_of
from trainer.curriculum import load_task

CommandLine = Callable[..., tuple[int, str, str]]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """An imported knee, without its surfaces, on a coarse grid of its own."""
    folder = tmp_path / "my knee"
    folder.mkdir()
    write_nrrd(library.load("knee", 1.6).volume, folder / imported.LABELS)
    (folder / imported.RECORD).write_text(json.dumps({"side": "right"}))
    return folder


@pytest.fixture
def task(tmp_path: Path) -> Path:
    """A task's file that ends soon, with a knee of two-millimetre voxels."""
    text = load_task("arthroscopy/probe-landmarks").text.replace("voxel_mm = 1.0", "voxel_mm = 2.0")
    path = tmp_path / "short.toml"
    path.write_text(text.replace("time_limit_s = 180.0", "time_limit_s = 1.2").replace("probe-landmarks", "short"))
    return path


def practised(command_line: CommandLine, db: Path, *arguments: object) -> tuple[int, str, str]:
    words = [str(a) for a in arguments]
    return command_line("practice", *words, "--fast", "--no-record", "--db", db, "--json")


def test_a_session_in_another_knee_is_replayed_in_it(
    command_line: CommandLine, task: Path, folder: Path, tmp_path: Path
) -> None:
    """And in no other: neither where a voxel has changed, nor where the folder has gone."""
    db = tmp_path / "log.db"
    code, out, err = practised(command_line, db, task, "--anatomy", folder)
    assert (code, err) == (0, "")
    found = json.loads(out)
    assert found["anatomy"] == str(folder)
    assert found["events"]["portal_enter"] == 1
    replay = ("sessions", "replay", "last", "--verify", "--db", db)
    assert command_line(*replay)[0] == 0
    before = library.fingerprint(imported.load(folder))
    kept = imported.load(folder).volume
    labels = kept.labels.copy()
    labels[0, 0, 0] = 5
    write_nrrd(LabelVolume(labels, kept.spacing_mm, kept.lps_from_volume), folder / imported.LABELS)
    code, _, err = command_line(*replay)
    assert code == 1
    assert (
        err.strip()
        .splitlines()[-1]
        .endswith(f"the knee '{folder}' has changed since session {found['session']} was practised in it")
    )
    (folder / imported.RECORD).unlink()
    code, _, err = command_line(*replay)
    assert code == 1
    assert "has no anatomy.json" in err.strip().splitlines()[-1]
    (folder / imported.LABELS).unlink()
    folder.rmdir()
    code, _, err = command_line(*replay)
    assert code == 1
    wanted = f"session {found['session']} was practised in the knee '{folder}' (SHA-256 {before[:16]}…): no knee "
    assert wanted in err.strip().splitlines()[-1]


def test_the_tasks_own_knee_is_stored_by_its_name(command_line: CommandLine, task: Path, tmp_path: Path) -> None:
    db = tmp_path / "log.db"
    code, out, _ = practised(command_line, db, task)
    assert (code, json.loads(out)["anatomy"]) == (0, "knee")
    assert command_line("sessions", "replay", "last", "--verify", "--db", db)[0] == 0


def test_a_task_with_vessels_as_well_takes_place_in_the_named_knee_too(
    command_line: CommandLine, folder: Path, tmp_path: Path
) -> None:
    """Its steps drive a needle and name no structure. A knee without the ligament that is to move is refused."""
    knee = load_task("arthroscopy/probe-landmarks").text.replace("voxel_mm = 1.0", "voxel_mm = 2.0")
    knee = knee[knee.index("[scene.anatomy]") : knee.index("[[scene.instrument]]")]
    text = load_task("anastomosis/needle-drive").text.replace("time_limit_s = 300.0", "time_limit_s = 0.1")
    text = text.replace("layers = 21", "layers = 9").replace("around = 24", "around = 8")
    both, db = tmp_path / "both.toml", tmp_path / "log.db"
    both.write_text(f"{text}\n{knee}")
    code, out, err = practised(command_line, db, both, "--anatomy", folder)
    assert (code, err) == (0, "")
    found = json.loads(out)
    assert (found["anatomy"], found["ticks"]) == (str(folder), 10)
    assert command_line("sessions", "replay", "last", "--verify", "--db", db)[0] == 0
    kept = imported.load(folder).volume
    without = np.where(kept.labels == number_of("anterior cruciate ligament"), 0, kept.labels).astype(np.uint8)
    write_nrrd(LabelVolume(without, kept.spacing_mm, kept.lps_from_volume), folder / imported.LABELS)
    code, out, err = practised(command_line, db, both, "--anatomy", folder)
    assert (code, out) == (1, "")
    assert "anatomy 'my knee' has no anterior cruciate ligament" in err


@pytest.mark.parametrize(
    ("reference", "anatomy", "message"),
    [
        ("arthroscopy/probe-landmarks", "nowhere", "no knee 'nowhere': expected knee, or a folder that"),
        ("arthroscopy/probe-landmarks", "scan.nrrd", "import it first: trainer anatomy import scan.nrrd --labels"),
        ("arthroscopy/probe-landmarks", ".", "no imported anatomy: it has no anatomy.json"),
        ("arthroscopy/ligament-2d", "knee", "this task takes place in no knee that could be another one"),
        ("anastomosis/needle-drive", "knee", "this task takes place in no knee that could be another one"),
    ],
)
def test_a_knee_that_cannot_be_had_is_told_in_one_line(
    command_line: CommandLine,
    reference: str,
    anatomy: str,
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scan.nrrd").write_bytes(b"NRRD0004\n")
    db = tmp_path / "log.db"
    code, out, err = practised(command_line, db, reference, "--anatomy", anatomy)
    assert (code, out) == (1, "")
    assert message in err
    assert len(err.strip().splitlines()) == 1
    assert not db.exists()
