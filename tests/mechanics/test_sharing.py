"""Work that is shared out: in how many pieces, in which order, and on which cores."""

from __future__ import annotations

import ast
import os
import subprocess
import sys

import pytest

from trainer.mechanics.sharing import FROM_ELEMENTS, MOST_THREADS, parts, share_out


def test_pieces_cover_all_once_and_results_come_in_their_order() -> None:
    """Also the piece that the caller does itself, and an empty range."""
    for begin, end in ((0, 100), (7, 9), (5, 5)):
        pieces = parts(begin, end, FROM_ELEMENTS)
        assert [i for a, b in share_out(lambda piece: piece, pieces) for i in range(a, b)] == list(range(begin, end))
    assert parts(0, 100, FROM_ELEMENTS - 1) == [(0, 100)]


def test_what_fails_in_a_piece_is_raised() -> None:
    def fail(piece: tuple[int, int]) -> None:
        raise ValueError(str(piece))

    for pieces in ([(0, 1)], [(0, 1), (1, 2)]):
        with pytest.raises(ValueError, match=r"^\([01], [12]\)$"):
            share_out(fail, pieces)


WORKED_BEFORE = """
from trainer.mechanics import sharing
for _ in range(20):
    sharing.share_out(len, [(0, 1), (1, 2)])
    sharing.start()
"""


def test_a_start_after_work_returns() -> None:
    """A pool that has worked may have fewer threads than it can have; 60 s is for ever."""
    subprocess.run([sys.executable, "-c", WORKED_BEFORE], check=True, timeout=60)


BESIDE_A_TICK = """
import os, threading
from trainer.mechanics import sharing
import trainer.own_core
trainer.own_core.CLAIM = f"test {os.getpid()}: core"
sharing.start()
with trainer.own_core.own_core():
    pieces = sharing.parts(0, 100, sharing.FROM_ELEMENTS)
    sharing.share_out(len, pieces)
    others = [t.native_id for t in threading.enumerate() if t.name.startswith("volume")]
    print([os.sched_getaffinity(thread) for thread in (0, *others)])
"""


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells where a thread runs")
def test_threads_work_on_other_cores_than_a_tick_that_has_one_to_itself() -> None:
    cores = os.sched_getaffinity(0)
    if len(cores) < 2:
        pytest.skip("there is one core only")
    told = subprocess.run([sys.executable, "-c", BESIDE_A_TICK], capture_output=True, text=True, check=True).stdout
    tick, *others = ast.literal_eval(told)
    assert len(tick) == 1
    assert others == [cores - tick] * max(1, min(len(cores) - 1, MOST_THREADS) - 1)
