"""Every shipped task by existing, and what a task's file may not say."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from trainer import curriculum, interactions
from trainer.config import ConfigError
from trainer.data_files import data_folder
from trainer.metrics.registry import check_targets

TASKS = [f"{family}/{name}" for family in curriculum.family_names() for name in curriculum.load_family(family).tasks]


def test_the_shipped_curricula_are_in_order() -> None:
    assert curriculum.check(data_folder("curricula"), check_targets) == []


def test_every_task_file_belongs_to_its_family() -> None:
    files = {
        f"{p.parent.name}/{p.stem}" for p in data_folder("curricula").glob("*/*.toml") if p.name != "curriculum.toml"
    }
    assert files == set(TASKS)


@pytest.mark.parametrize("reference", TASKS)
def test_a_shipped_task_loads_and_names_its_sources(reference: str) -> None:
    task_file = curriculum.load_task(reference)
    assert task_file.task == curriculum.parse_task(task_file.text, "again")
    assert f"{reference.split('/')[0]}/{task_file.task.name}" == reference
    assert all(limit.source for limit in task_file.task.limits.values())
    for metric in task_file.task.metric:
        assert metric.source
        if metric.low is not None and metric.high is not None:
            assert metric.low <= metric.high


@pytest.mark.parametrize("reference", TASKS)
def test_a_needle_can_go_round_in_the_vessel(reference: str) -> None:
    """A needle's circle, length / arc, is of the vessel's size: between half and four times its outer radius.

    A factor of 1000 from a unit mixed up (metres, micrometres) would be far outside.
    """
    scene = curriculum.load_task(reference).task.scene
    if scene.needle is not None:
        radius = scene.needle.length_mm / math.radians(scene.needle.arc_deg)
        for vessel in scene.vessel:
            assert 0.25 * vessel.outer_diameter_mm < radius < 4 * vessel.outer_diameter_mm


def test_the_hash_is_that_of_the_text() -> None:
    first, second = (curriculum.load_task(reference) for reference in TASKS[:2])
    assert first.sha256 == curriculum.load_task(TASKS[0]).sha256 != second.sha256


@pytest.mark.parametrize("reference", ["nowhere/task", "anastomosis/nothing", "anastomosis", "../x/y"])
def test_an_unknown_task_is_answered_with_the_known_ones(reference: str) -> None:
    with pytest.raises(ConfigError, match=f"^unknown task '{reference}'; known: .*anastomosis/single-stitch"):
        curriculum.load_task(reference)


def changed(old: str, new: str) -> str:
    text = curriculum.load_task("anastomosis/single-stitch").text
    assert old in text
    return text.replace(old, new, 1)


WRONG: list[tuple[str, str, str]] = [
    ("wall_mm = 0.15", "wall_um = 150.0", r"\[scene\.vessel\[0\]\]: unknown key 'wall_um', did you mean 'wall_mm'"),
    ("wall_mm = 0.15", "wall_mm = 0.5", r"'wall_mm' must be less than half of 'outer_diameter_mm'"),
    ("around = 24", "around = 23", r"'around' must be even"),
    ("axis = [-1.0, 0.0, 0.0]", "axis = [0.0, 0.0, 0.0]", r"'axis' must not be the zero vector"),
    ("tick_hz = 100.0", "tick_hz = 10.0", r"'tick_hz' must be >= 20 and <= 2000, found 10"),
    ("time_limit_s = 300.0", 'time_limit_s = "5 min"', r"'time_limit_s' expected a number, found str '5 min'"),
    ('name = "B"', 'name = "A"', r"\[scene\]: two entries of 'vessel' share a name"),
    ('held_by = "right"', 'held_by = "foot"', r"'needle\.held_by' names no instrument: 'foot'"),
    (
        'vessel = "B"',
        'vessel = "C"',
        r"step 'through the wall of B, from inside out' names no vessel of the scene: 'C'",
    ),
    ('direction = "out"', 'direction = "up"', r"'step\[1\]\.direction' must be one of 'in', 'out', found 'up'"),
    ("bite_mm = 0.35", "bite_mm = 2.5", r"'bite_mm' must not exceed the vessel's 'length_mm'"),
    ("link_mm = 0.2", "link_mm = 0.001", r"'length_mm' must be at most 10000 times 'link_mm'"),
    ("length_mm = 2.0", "length_mm = 43.0", r"'layers' are too few: they must lie at most two outer diameters apart"),
    ("length_mm = 2.0", "length_mm = 1e30", r"'scene\.vessel\[0\]\.length_mm' must be >= 0\.0001 and <= 1000"),
    ("value = 500.0", "value = 1e300", r"'scene\.vessel\[0\]\.modulus_kPa' must be >= 1e-06 and <= 1e\+09"),
    ("value = 1.0", "value = 1e300", r"'scene\.vessel\[0\]\.puncture_outer_mN' must be > 0 and <= 1e\+06"),
    ("home_mm = [-1.5,", "home_mm = [1e300,", r"'scene\.instrument\[0\]\.home_mm\[0\]' must be >= -100000 and <="),
    ("node_error_mm = 0.003", "node_error_mm = 0", r"'solver\.node_error_mm' must be > 0 and <= 1000, found 0"),
    ("node_error_mm", "node_error_um", r"\[solver\]: unknown key 'node_error_um', did you mean 'node_error_mm'"),
    ("axis = [-1.0, 0.0, 0.0]", "axis = [-1e-200, 0.0, 0.0]", r"'axis' must not be the zero vector"),
    ('kind = "forceps"', 'kind = "forceps"\nopen_at = 0.8', r"'open_at' must be less than 'close_at'"),
    ("tissue_pull =", "tissue_love =", r"unknown limit 'limits\.tissue_love', did you mean 'tissue_pull'\?"),
    ("tissue_pull =", "x =", r"unknown limit 'limits\.x'; known: tissue_pull, grasp_pressure, probe_force"),
    ('unit = "kPa"', 'unit = "psi"', r"'limits\.grasp_pressure\.unit' must be 'kPa', found 'psi'"),
    ('unit = "mN"', 'unit = "kPa"', r"'limits\.tissue_pull\.unit' must be 'mN', found 'kPa'"),
    ("link_mm = 0.2", "link_mm = 200.0", r"\[scene\.thread\]: 'link_mm' must be at most 'length_mm'"),
    ("low = 70.0", "low = 91.0", r"\[metric\[0\]\]: 'low' must be at most 'high', found 91 and 90"),
    ('"entry_angle_deg"', '"bite_ratio"', r"two entries of 'metric' are of 'bite_ratio'"),
    ("length_mm = 3.8", "length_mm = 38.0", r"'needle\.length_mm' must be more than .* at most 10 of its outer"),
    ("length_mm = 3.8", "length_mm = 0.1", r"must be more than the wall of vessel 'A', 0\.15 mm, .* found 0\.1"),
    ("wire_mm = 0.07", "wire_mm = 0.7", r"wire_mm' must be less than the lumen of vessel 'A', 0\.7 mm, found 0\.7"),
]


@pytest.mark.parametrize(("old", "new", "message"), WRONG, ids=[new for _, new, _ in WRONG])
def test_a_wrong_task_is_refused_in_one_line(old: str, new: str, message: str) -> None:
    with pytest.raises(ConfigError, match=rf"^t\.toml: .*{message}") as caught:
        curriculum.parse_task(changed(old, new), "t.toml")
    assert "\n" not in str(caught.value)


def test_a_task_can_limit_what_the_rules_ask_about() -> None:
    """A limit that no rule asks about would be kept and never exceeded."""
    rules = Path(interactions.__path__[0]).glob("*.py")
    asked = {name for rule in rules for name in re.findall(r'check_limit\(world, "(\w+)"', rule.read_text())}
    assert asked == set(curriculum.LIMITS)


def test_a_thread_needs_a_needle() -> None:
    text = curriculum.load_task("anastomosis/single-stitch").text
    begin, end = text.index("[scene.needle]"), text.index("[scene.thread]")
    with pytest.raises(ConfigError, match="a 'thread' needs a 'needle' at its head"):
        curriculum.parse_task(text[:begin] + text[end:], "t.toml")


def test_a_component_that_is_not_named_is_none() -> None:
    text = curriculum.load_task("anastomosis/single-stitch").text
    begin, end = text.index("[scene.thread]"), text.index("[[scene.instrument]]")
    assert curriculum.parse_task(text[:begin] + text[end:], "t.toml").scene.thread is None


def test_a_task_without_a_solver_has_the_default_budget() -> None:
    text = curriculum.load_task("anastomosis/single-stitch").text
    begin, end = text.index("[solver]"), text.index("[limits]")
    assert curriculum.parse_task(text[:begin] + text[end:], "t.toml").solver == curriculum.SolverSpec(0.003)


def write_family(folder: Path) -> None:
    (folder / "curriculum.toml").write_text('name = "f"\ntitle = "F"\nsummary = "f"\ntasks = ["a"]\n')


def write_misnamed(folder: Path) -> None:
    (folder / "other.toml").write_text(curriculum.load_task("anastomosis/single-stitch").text)


def write_unmeasured(folder: Path) -> None:
    (folder / "single-stitch.toml").write_text(changed('"entry_angle_deg"', '"entry_angle_rad"'))


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda folder: None, "holds no TOML file"),
        (write_family, "task 'a' has no file a.toml"),
        (write_misnamed, "'name' must equal the file's name, found 'single-stitch'"),
        (write_unmeasured, "single-stitch.toml: task 'single-stitch': no metric 'entry_angle_rad', did you mean"),
    ],
)
def test_check_says_what_is_wrong_with_a_folder(tmp_path: Path, write: Callable[[Path], None], message: str) -> None:
    write(tmp_path)
    problems = curriculum.check(tmp_path, check_targets)
    assert len(problems) == 1
    assert message in problems[0]


def test_check_names_a_path_that_is_not_there(tmp_path: Path) -> None:
    assert curriculum.check(tmp_path / "x.toml", check_targets) == [f"{tmp_path / 'x.toml'}: no such file"]
