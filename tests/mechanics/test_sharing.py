"""Work that is shared out: in how many pieces, in which order, and on which cores."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
import threading

import pytest

from trainer.mechanics.sharing import FROM_ELEMENTS, MOST_THREADS, parts, share_out, start


def test_pieces_cover_all_once_and_results_come_in_their_order() -> None:
    """Also the piece that the caller does itself, and an empty range."""
    for begin, end in ((0, 100), (7, 9), (5, 5)):
        pieces = parts(begin, end, FROM_ELEMENTS)
        assert [i for a, b in share_out(lambda piece: piece, pieces) for i in range(a, b)] == list(range(begin, end))
        assert len(pieces) <= MOST_THREADS
    assert parts(0, 100, FROM_ELEMENTS - 1) == [(0, 100)]


def test_what_fails_in_a_piece_is_raised() -> None:
    def fail(piece: tuple[int, int]) -> None:
        raise ValueError(str(piece))

    for pieces in ([(0, 1)], [(0, 1), (1, 2)]):
        with pytest.raises(ValueError, match=r"^\(0, 1\)$"):
            share_out(fail, pieces)


def test_the_threads_are_there_after_the_start() -> None:
    start()
    start()
    assert sum(t.name.startswith("volume") for t in threading.enumerate()) >= MOST_THREADS - 1


BESIDE_A_TICK = """
import os, threading
from trainer.mechanics import sharing
from trainer.own_core import own_core
import trainer.own_core
trainer.own_core.CLAIM = f"test {os.getpid()}: core"
sharing.start()
with own_core():
    together = threading.Barrier(len(sharing.parts(0, 100, sharing.FROM_ELEMENTS)))
    def where(piece):
        together.wait()
        return os.sched_getaffinity(0)
    print(sharing.share_out(where, sharing.parts(0, 100, sharing.FROM_ELEMENTS)))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells where a thread runs")
def test_threads_work_on_other_cores_than_a_tick_that_has_one_to_itself() -> None:
    cores = os.sched_getaffinity(0)
    if len(cores) < 2:
        pytest.skip("there is one core only")
    told = subprocess.run([sys.executable, "-c", BESIDE_A_TICK], capture_output=True, text=True, check=True).stdout
    first, *others = ast.literal_eval(told)
    assert len(first) == 1
    assert len(others) >= 1
    assert all(other == cores - first for other in others)
