"""The vocabulary: every kind goes into a row and comes back the same, bit for bit."""

from __future__ import annotations

import dataclasses
import inspect
import json
import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trainer import events
from trainer.events import Event

ALL = sorted(events.KINDS)
VALUES: dict[str, st.SearchStrategy[Any]] = {
    "int": st.integers(-(2**53), 2**53),
    "float": st.floats(allow_nan=False, allow_infinity=False),
    "str": st.text(),
    "Vector": st.tuples(*[st.floats(allow_nan=False, allow_infinity=False)] * 3),
}


@st.composite
def any_event(draw: st.DrawFn, kind: str) -> Event:
    cls = events.KINDS[kind]
    return cls(**{field.name: draw(VALUES[str(field.type)]) for field in dataclasses.fields(cls)})


@pytest.mark.parametrize("kind", ALL)
@given(data=st.data())
def test_an_event_comes_back_from_its_row(kind: str, data: st.DataObject) -> None:
    event = data.draw(any_event(kind))
    text = events.payload(event)
    again = events.from_row(event.tick, event.seq, event.time_s, event.tool, event.kind, text)
    assert again == event
    assert type(again) is type(event)
    assert events.payload(again) == text


@pytest.mark.parametrize("kind", ALL)
def test_a_row_holds_each_field_once(kind: str) -> None:
    event = _plain(kind)
    stored = json.loads(events.payload(event))
    own = [f.name for f in dataclasses.fields(event) if f.name not in {"tick", "seq", "time_s", "tool"}]
    assert list(stored) == own


def _plain(kind: str) -> Event:
    plain: dict[str, Any] = {"int": 1, "float": 0.5, "str": "x", "Vector": (1.0, 2.0, 3.0)}
    cls = events.KINDS[kind]
    return cls(**{field.name: plain[str(field.type)] for field in dataclasses.fields(cls)})


@pytest.mark.parametrize("kind", ALL)
def test_every_kind_is_documented_and_frozen(kind: str) -> None:
    cls = events.KINDS[kind]
    assert cls.kind == kind
    assert inspect.getdoc(cls) != inspect.getdoc(Event)
    with pytest.raises(dataclasses.FrozenInstanceError):
        _plain(kind).tick = 2  # type: ignore[misc]


def test_every_event_class_is_registered() -> None:
    classes = {c for c in vars(events).values() if inspect.isclass(c) and issubclass(c, Event) and c is not Event}
    assert set(events.KINDS.values()) == classes


def test_only_the_clock_makes_events_that_a_replay_does_not() -> None:
    assert [kind for kind in ALL if not events.KINDS[kind].simulated] == ["tick_overrun"]


@pytest.mark.parametrize("number", [math.nan, math.inf])
def test_what_is_not_finite_does_not_enter_the_log(number: float) -> None:
    with pytest.raises(ValueError, match="not JSON compliant"):
        events.payload(events.TrackingBack(1, 0, 0.01, "left", lost_s=number))


def test_an_older_log_knows_of_no_reason() -> None:
    assert events.from_row(7, 0, 0.0, "left", "tracking_lost", "{}") == events.TrackingLost(7, 0, 0.0, "left")


def test_an_unknown_kind_and_fields_that_do_not_fit_are_named() -> None:
    with pytest.raises(ValueError, match="unknown kind of event 'sneeze'"):
        events.from_row(1, 0, 0.0, "", "sneeze", "{}")
    with pytest.raises(ValueError, match=r"event 'tracking_back' at tick 7: .*lost_s"):
        events.from_row(7, 0, 0.0, "left", "tracking_back", "{}")
