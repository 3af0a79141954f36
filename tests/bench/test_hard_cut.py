"""The hard case of a cut: its laws hold, and a solver that breaks them is found."""

from __future__ import annotations

import numpy as np
import pytest

from trainer.bench import hard_cut
from trainer.mechanics.equilibrium import Equilibrium


def test_each_cut_keeps_its_laws() -> None:
    """Not in real time, and once: nothing is said of how long it takes."""
    links = [run.args[0] for _, _, run in hard_cut.cases()]  # type: ignore[attr-defined]
    assert [len(k) for k in links[:-1]] == list(hard_cut.COUNTS)
    for cut in links:
        assert hard_cut.outcome(cut, 0.0, 1).startswith("ok: ticks ")


def test_a_link_that_still_bears_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """A cut that leaves one of them: the mesh without it is not in equilibrium there."""
    links = np.array(hard_cut.cases()[1][2].args[0])  # type: ignore[attr-defined]
    cut = Equilibrium.cut
    monkeypatch.setattr(Equilibrium, "cut", lambda state, given: cut(state, given[:-5]))
    with pytest.raises(AssertionError, match="and it says that it converged"):
        hard_cut.outcome(links, 0.0, 1)
