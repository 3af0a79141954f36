"""How a recording opens: the scene, forces over time, what the hands hold, the log and the scores."""

from __future__ import annotations

import rerun.blueprint as rrb

from trainer.sinks.surface import Layout

BACKGROUND = (24, 30, 38)
PICTURES = ("surface", "section", "volume")


def blueprint(layout: Layout) -> rrb.Blueprint:
    """The arrangement that travels inside the recording, and where its eye is."""
    scene = rrb.Spatial3DView(
        origin="/world",
        name="Scene",
        background=rrb.Background(color=BACKGROUND),
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital, position=layout.eye_mm, look_target=layout.look_at_mm, eye_up=(0.0, 0.0, 1.0)
        ),
    )
    forces = rrb.TimeSeriesView(origin="/force", name="Force (mN)")
    closures = rrb.TimeSeriesView(
        origin="/closure", name="Closure of the jaws", axis_y=rrb.ScalarAxis(range=(0.0, 1.0), zoom_lock=True)
    )
    states = rrb.StateTimelineView(origin="/state", name="Step and hands")
    log = rrb.TextLogView(
        origin="/events", name="Events", columns=rrb.TextLogColumns(text_log_columns=["LogLevel", "Body"])
    )
    scores = rrb.TextDocumentView(origin="/scores", name="Scores")
    pictures = rrb.Horizontal(
        *(rrb.Spatial2DView(origin=f"/pictures/{name}", name=name.capitalize()) for name in PICTURES), name="Pictures"
    )
    seen = scene if layout.pictures is None else rrb.Vertical(scene, pictures, row_shares=[2, 1])
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(seen, states, row_shares=[3, 1]),
            rrb.Vertical(forces, rrb.Tabs(scores, closures), log, row_shares=[2, 2, 3]),
            column_shares=[3, 2],
        ),
        rrb.TimePanel(timeline="sim_time", state="collapsed", fps=30.0),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
    )
