"""Metrics of handled tissue on a session whose scores are known."""

from __future__ import annotations

import pytest

from tests.metrics.synthetic_session import (
    LANDMARKS,
    LIGAMENT,
    STITCH,
    landmarks,
    ligament,
    performed,
    record,
    task_of,
)
from trainer.metrics import score
from trainer.reporting.session import session_report


def test_the_scores_of_a_known_session() -> None:
    """Distances, sums and counts as :func:`ligament` states them; sums of a few numbers are exact."""
    found = {m.name: m.value for m in score(ligament(), task_of(LIGAMENT))}
    expected = {
        "grasp_error_mm": 3.0, "cut_error_mm": 4.0, "cut_volume_mm3": 80.0, "stroke_count": 2.0,
        "tear_volume_mm3": 12.0, "iatrogenic_contact_count": 1.0, "structures_touched_count": 2.0,
        "pull_max_mN": 9e3, "retraction_mm": 1.6,
    }  # fmt: skip
    assert {name: found[name] for name in expected} == pytest.approx(expected, rel=1e-12)


def test_the_scores_of_known_touches() -> None:
    """As :func:`landmarks` states them."""
    found = {m.name: m.value for m in score(landmarks(), task_of(LANDMARKS))}
    expected = {
        "probe_force_max_mN": 640.0, "landmarks_touched_count": 3.0, "portal_entry_count": 2.0,
        "iatrogenic_contact_count": 1.0, "structures_touched_count": 4.0, "overforce_count": 0.0,
    }  # fmt: skip
    assert {name: found[name] for name in expected} == expected
    nothing = {m.name: m.value for m in score(record(reference=LANDMARKS), task_of(LANDMARKS))}
    assert nothing["probe_force_max_mN"] is nothing["overforce_count"] is None


def test_whoever_did_nothing_pulled_and_cut_nothing() -> None:
    found = {m.name: m.value for m in score(record(reference=LIGAMENT), task_of(LIGAMENT))}
    assert found["pull_max_mN"] is found["retraction_mm"] is found["cut_error_mm"] is None
    assert found["cut_volume_mm3"] == 0.0


def test_a_report_tells_what_was_done_to_each_structure() -> None:
    rows = {r.structure: r for r in session_report(ligament(), task_of(LIGAMENT)).tissue}
    pcl = rows["posterior cruciate ligament"]
    assert (pcl.grasps, pcl.tacked_mm3, pcl.cut_mm3, pcl.torn_mm3) == (1, 90.0, 80.0, 12.0)
    assert rows["tibia"].contacts == 1
    assert session_report(performed(), task_of(STITCH)).tissue == ()
