"""A scene in which nobody can practise is refused, by whoever builds it and by the check of a curriculum."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from trainer import curriculum, scene
from trainer.config import ConfigError

CommandLine = Callable[..., tuple[int, str, str]]

STITCH, SECTION, KNEE = "anastomosis/single-stitch", "arthroscopy/ligament-2d", "arthroscopy/probe-landmarks"

WRONG = [
    (STITCH, "cut_edge_mm = [0.3, 0.0, 0.0]", "cut_edge_mm = [-2.3, 0.0, 0.0]", "vessel 'A' lies in vessel 'B'"),
    (STITCH, "cut_edge_mm = [0.3,", "cut_edge_mm = [-0.4,", "vessel 'A' lies in vessel 'B'"),
    (SECTION, "place_mm = [-4.0, -14.0,", "place_mm = [300.0, -14.0,", r"'step\[0\]\.place_mm' is \d+ mm from"),
    (SECTION, "home_mm = [28.0, -16.0,", "home_mm = [-10.0, 15.0,", r"'scene\.instrument\[0\]\.home_mm' lies in the"),
    (KNEE, "portal_mm = [30.0,", "portal_mm = [3000.0,", r"'scene\.instrument\[0\]\.portal_mm' is 2940 mm from"),
    (KNEE, "portal_mm = [30.0, -6.0, 8.0]", "portal_mm = [0.0, 35.0, 0.0]", r"portal_mm' lies in the femur"),
    (KNEE, 'about = "anterior cruciate ligament"', 'about = "spleen"', "unknown structure 'spleen'; known: femur"),
    (KNEE, 'structure = "femoral cartilage"', 'structure = "spleen"', "unknown structure 'spleen'; known: femur"),
    (KNEE, 'name = "knee"', 'name = "elbow"', "no knee 'elbow': expected knee"),
    (KNEE, "= [-40.0, -35.0, -45.0]", "= [50.0, 30.0, 35.0]", "has no anterior cruciate ligament and no"),
]  # fmt: skip


@pytest.mark.parametrize(("reference", "old", "new", "message"), WRONG, ids=[new for _, _, new, _ in WRONG])
def test_a_scene_for_nobody_is_refused(reference: str, old: str, new: str, message: str) -> None:
    text = curriculum.load_task(reference).text.replace("voxel_mm = 1.0", "voxel_mm = 2.0")
    assert old in text
    with pytest.raises(ConfigError, match=f"^task '{reference.split('/')[1]}': .*{message}") as caught:
        scene.build(curriculum.parse_task(text.replace(old, new, 1), "t.toml"))
    assert "\n" not in str(caught.value)


def test_ends_that_touch_are_two_vessels() -> None:
    """The gap may be nothing: then a stitch has nothing to draw together, but there is one."""
    text = curriculum.load_task(STITCH).text
    text = text.replace("[-0.3, 0.0, 0.0]", "[0.0, 0.0, 0.0]").replace("[0.3, 0.0, 0.0]", "[0.0, 0.0, 0.0]")
    scene.build(curriculum.parse_task(text, "t.toml"))


def test_the_check_of_a_curriculum_builds_the_scene(command_line: CommandLine, tmp_path: Path) -> None:
    path = tmp_path / "ligament-2d.toml"
    text = curriculum.load_task(SECTION).text
    path.write_text(text)
    assert command_line("curricula", "check", path) == (0, f"{path}: in order\n", "")
    path.write_text(text.replace("place_mm = [-4.0,", "place_mm = [300.0,"))
    code, out, err = command_line("curricula", "check", path)
    assert (code, out, len(err.splitlines())) == (1, "", 1)
    assert err.startswith(f"{path}: task 'ligament-2d': 'step[0].place_mm' is ")
