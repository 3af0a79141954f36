"""What a recording shows of a knee: closed surfaces, moving elements, and pictures of what they are now."""

from __future__ import annotations

import numpy as np

from trainer import scene
from trainer.anatomy.structures import structures
from trainer.anatomy.surfaces import is_closed
from trainer.curriculum import load_task
from trainer.poses import ToolPoses

PCL = "posterior cruciate ligament"


def test_rigid_structures_are_closed_surfaces_and_what_moves_is_drawn_where_it_is() -> None:
    """Pulled back by 3 mm, the ligament is elsewhere in each of the three pictures."""
    s = scene.build(load_task("arthroscopy/ligament-release").task)
    layout = s.layout()
    names = {surface.name.removeprefix("anatomy/").replace("_", " ") for surface in layout.surfaces}
    assert names == set(structures()) - {PCL, "patella", "patellar cartilage"}  # which lie outside of the block
    assert all(surface.fixed is not None and is_closed(surface.triangles) for surface in layout.surfaces)
    assert [(c.name, c.fixed) for c in layout.clouds] == [("tissue/posterior_cruciate_ligament", None)]
    assert layout.pictures is not None
    before = layout.pictures(layout.frame(s.snapshot()))
    now = s.view().poses
    for x, closure in ((-3.0, 0.0), (-3.0, 0.9), (-4.5, 0.9), (-6.0, 0.9)):
        position = now.position.copy()
        position[0] = s.world.world_from_scene.apply(np.array([x, -3.0, 0.0]))
        s.step(ToolPoses(position, now.quaternion, np.array([closure, 0.0]), np.ones(2, dtype=bool)))
    after = layout.pictures(layout.frame(s.snapshot()))
    assert list(before) == ["surface", "section", "volume"]
    for name, picture in before.items():
        assert picture.shape == (200, 200, 3)
        assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 3, name
        assert (picture != after[name]).any(), name
    colour, row = structures()[PCL].colour, round(100 + 3.0 / 0.4)  # 80 mm on 200 pixels; y = -3 mm
    left = [np.flatnonzero((p["section"][row] == colour).all(axis=-1)).min() for p in (before, after)]
    assert left[0] - left[1] >= round((3.0 - 1.0) / 0.4)  # x runs to the right; a voxel may be lost to rounding
