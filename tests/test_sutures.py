"""Sizes of sutures: every one loads, fills in what a task leaves out, and a thicker one is stronger."""

from __future__ import annotations

import itertools
import re
from pathlib import Path

import pytest

from trainer.config import ConfigError
from trainer.curriculum import check, load_task, parse_task, sutures
from trainer.data_files import data_folder

TEXT = load_task("anastomosis/single-stitch").text
#: The same task, with nothing but a size.
SIZED = re.sub(r"^(diameter_mm|strength_mN) = .*\n", "", TEXT, flags=re.MULTILINE)


@pytest.mark.parametrize("size", list(sutures()))
def test_a_size_says_diameter_and_strength(size: str) -> None:
    thread = parse_task(SIZED.replace('"10-0"', f'"{size}"'), "sized").scene.thread
    assert thread is not None
    assert (thread.diameter_mm, thread.strength_mN) == (sutures()[size].diameter_mm, sutures()[size].strength_mN)


def test_a_thicker_suture_is_stronger() -> None:
    for thick, thin in itertools.pairwise(sutures().values()):
        assert thick.diameter_mm.value > thin.diameter_mm.value
        assert thick.strength_mN.value > thin.strength_mN.value


def test_what_the_task_says_itself_goes_before() -> None:
    thread = parse_task(TEXT, "typed").scene.thread
    assert thread is not None
    assert thread.strength_mN.value == 710.0 != sutures()["10-0"].strength_mN.value


def test_an_unknown_size_is_told_in_one_line() -> None:
    with pytest.raises(ConfigError) as told:
        parse_task(SIZED.replace('"10-0"', '"10/0"'), "mine.toml")
    assert str(told.value) == (
        "mine.toml: 'scene.thread.size' must be one of '8-0', '9-0', '10-0', '11-0' (curricula/sutures.toml), "
        "found '10/0'"
    )


def test_the_file_of_sizes_is_checked_like_a_task(tmp_path: Path) -> None:
    path = data_folder("curricula") / "sutures.toml"
    assert check(path, lambda task: None) == []
    wrong = tmp_path / "sutures.toml"
    wrong.write_text(path.read_text(encoding="utf-8").replace("0.045", "-0.045"), encoding="utf-8")
    assert check(wrong, lambda task: None) == [
        f"{wrong}: '8-0.diameter_mm' must be >= 0.0001 and <= 1000, found -0.045"
    ]
