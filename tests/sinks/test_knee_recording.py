"""What a recording of a task in a knee holds: the surfaces of what is rigid once, and pictures at each step."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from stitch_frames import header
from test_recording_sink import rows, rrd

from trainer import scene
from trainer.curriculum import load_task
from trainer.sinks.recording import RecordingSink
from trainer.sinks.surface import TickRecord


def test_a_knee_is_recorded_with_its_surfaces_and_pictures(tmp_path: Path) -> None:
    """Pictures are drawn of the first frame, of the first after each step that was done, and of the last."""
    knee = load_task("arthroscopy/probe-landmarks").task
    task = replace(knee, scene=replace(knee.scene, instrument=(replace(knee.scene.instrument[0], tool="left"),)))
    s = scene.build(task)
    path = tmp_path / "knee.rrd"
    sink = RecordingSink(path, replace(header(), tools=("left",)), s.layout(), 100.0, realtime=False)
    target = s.view().in_sight("femoral cartilage", s.view().place(np.array(knee.scene.instrument[0].portal_mm)))
    assert target is not None
    done = 0
    for tick in range(40):
        poses = s.view().poses
        share = min(1.0, tick / 20.0)
        position = poses.position + (target - poses.position) * share
        moved = replace(poses, position=position)
        events = s.step(moved) if tick < 39 else s.finish("aborted", "enough")
        done += sum(e.kind == "step_done" for e in events)
        sink.tick(TickRecord(tick, tick / 100.0, moved, events, s.snapshot))
    sink.close()
    assert done == 1
    assert rrd("verify", path).returncode == 0
    for name in ("surface", "section", "volume"):
        pictures = rows(path, f"pictures/{name}", "Image:buffer")
        assert len(pictures) == 3
        assert min(pictures) == 0
        assert max(pictures) == 39
    femur = rows(path, "world/anatomy/femur", "Mesh3D:vertex_positions")
    assert list(femur) == [None]
    assert len(rows(path, "world/tissue/anterior_cruciate_ligament", "Points3D:positions")) == 11
