"""A packed row of poses is what the log stores: it must come back bit for bit."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from trainer.geometry import Array
from trainer.poses import NUMBERS_PER_TOOL, ToolPoses

TOOLS = st.integers(0, 4)


@given(TOOLS.flatmap(lambda k: hnp.arrays(np.float64, (k, 8))), st.data())
def test_poses_come_back_from_a_packed_row(numbers: Array, data: st.DataObject) -> None:
    valid = data.draw(hnp.arrays(np.bool_, len(numbers)))
    poses = ToolPoses(numbers[:, 0:3], numbers[:, 3:7], numbers[:, 7], valid)
    row = poses.pack()
    assert row.shape == (NUMBERS_PER_TOOL * len(numbers),)
    again = ToolPoses.unpack(row)
    assert again.valid.dtype == np.bool_
    for name in ("position", "quaternion", "closure", "valid"):
        assert np.array_equal(getattr(again, name), getattr(poses, name), equal_nan=name != "valid")
    assert again.pack().tobytes() == row.tobytes()


def test_a_row_is_position_quaternion_closure_and_validity_of_each_tool() -> None:
    poses = ToolPoses(
        position=np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]),
        quaternion=np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]]),
        closure=np.array([0.25, 0.75]),
        valid=np.array([True, False]),
    )
    assert poses.pack().tolist() == [1, 2, 3, 1, 0, 0, 0, 0.25, 1, 4, 5, 6, 0, 1, 0, 0, 0.75, 0]


def test_a_row_of_another_length_is_refused() -> None:
    with pytest.raises(ValueError, match="reshape"):
        ToolPoses.unpack(np.zeros(10))


def test_world_from_tool_places_the_jaws() -> None:
    """Half a turn about z takes the tool's +x to -x of the world."""
    poses = ToolPoses(np.array([[1.0, 2.0, 3.0]]), np.array([[0.0, 0.0, 0.0, 1.0]]), np.zeros(1), np.ones(1, bool))
    np.testing.assert_allclose(poses.world_from_tool(0).apply([1.0, 0.0, 0.0]), [0.0, 2.0, 3.0], atol=1e-15)
