"""Tidy tables of poses: columns in any order, tools with times of their own, and a bad cell is named by its line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.drivers.format_samples import put, table
from trainer.config import ConfigError
from trainer.drivers import pose_table

HEAD = "qx,time_s,note,tool,x_mm,y_mm,z_mm,qw,qy,qz\n"


def test_columns_in_any_order_and_others_beside_them(tmp_path: Path) -> None:
    text = HEAD + '0,1.5,"a, b\nc",left,1,2,3,1,0,0\n0.6,1.75,,left,4,5,6,0.8,0,0\n'
    motion = pose_table.read(put(tmp_path, ".csv", text.encode()))
    track = motion.track("left")
    assert motion.time.tolist() == [1.5, 1.75]
    assert track.position.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert track.quaternion.tolist() == [[1, 0, 0, 0], [0.8, 0.6, 0, 0]]
    assert track.ok.all()
    assert track.closure is None
    assert motion.frame_number.tolist() == [0, 1]


def test_tools_with_times_of_their_own(tmp_path: Path) -> None:
    """left at 0, 2 and 4 s, right at 1 and 3 s: at 1 s left is half way; outside of its samples right is not seen."""
    rows = [f"0,{t},,{'left' if t % 2 == 0 else 'right'},{t},0,0,1,0,0" for t in range(5)]
    motion = pose_table.read(put(tmp_path, ".csv", (HEAD + "\n".join(rows) + "\n").encode()))
    assert motion.track("left").position[:, 0].tolist() == [0, 1, 2, 3, 4]
    assert motion.track("left").ok.all()
    assert motion.track("right").ok.tolist() == [False, True, True, True, False]
    assert motion.track("right").position[1:4, 0].tolist() == [1, 2, 3]


def test_frame_numbers_tell_gaps_also_of_tools_with_times_of_their_own(tmp_path: Path) -> None:
    assert pose_table.read(put(tmp_path, ".csv", table(4))).frame_number.tolist() == [100, 101, 102, 103]
    assert pose_table.read(put(tmp_path, ".csv", table(4).replace(b"103,", b"107,"))).gaps == 1
    by_turns = "".join(f"0,{t},{t + t // 3},{'left' if t % 2 else 'right'},{t},0,0,1,0,0\n" for t in range(5))
    motion = pose_table.read(put(tmp_path, ".csv", (HEAD.replace("note", "tick") + by_turns).encode()))
    assert motion.frame_number.tolist() == [0, 1, 2, 4, 5]


def test_what_stands_where_a_tool_was_not_seen_does_not_matter(tmp_path: Path) -> None:
    content = table(3).replace(b"101,8.010000,left,11.0,2.0,3.0", b"101,8.010000,left,,nan,?")
    lines = content.split(b"\n")
    lines[3] = lines[3][:-1] + b"0"
    track = pose_table.read(put(tmp_path, ".csv", b"\n".join(lines))).track("left")
    assert track.ok.tolist() == [True, False, True]
    assert np.isfinite(track.position).all()
    assert track.closure is not None
    assert track.closure.tolist() == [0.0, 0.1, 0.2]


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        (b"qw,", b"qq,", "no column 'qw'; expected time_s, tool, x_mm"),
        (b",1\n", b"\n", "line 2 has 11 of 12 cells"),
        (b"left,10.0", b"left,ten", "line 2: 'x_mm' expected a number, found 'ten'"),
        (b"left,10.0", b"left,1e999", "line 2: 'x_mm' is not finite"),
        (b"left,10.0", b"left,1e300", "line 2: the position is farther than 1 km"),
        (b",1\n", b",yes\n", "line 2: 'valid' expected 0 or 1, found 'yes'"),
        (b"8.010000,right", b"7.010000,right", "line 5: time goes back from 7.990000 s to 7.010000 s"),
        (b"1.000000000,0,0", b"1.100000000,0,0", "line 2: the quaternion is not of length 1"),
        (b"100,", b"1.5,", "line 2: 'frame' is not a whole number"),
        (b"0.100,1\n", b",1\n", "line 4: 'closure' expected a number, found ''"),
        (b"left", b'"left', "line|has"),
    ],
)
def test_a_bad_cell_is_named_by_its_line(tmp_path: Path, old: bytes, new: bytes, complaint: str) -> None:
    path = put(tmp_path, ".csv", table(3).replace(old, new, 1))
    with pytest.raises(ConfigError, match=complaint) as caught:
        pose_table.read(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_a_table_of_several_sessions_is_refused(tmp_path: Path) -> None:
    text = HEAD.replace("note", "session") + "0,1,S1,left,0,0,0,1,0,0\n0,2,S2,left,0,0,0,1,0,0\n"
    with pytest.raises(ConfigError, match=r"holds 2 sessions \(S1, S2\); keep the rows of one"):
        pose_table.read(put(tmp_path, ".csv", text.encode()))
