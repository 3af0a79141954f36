"""The thread that ticks keeps a core to itself, and gives it back."""

from __future__ import annotations

import os
import sys
import threading

import pytest

from trainer.own_core import own_core

linux = pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells where a thread runs")


@linux
def test_other_threads_keep_off_the_core_of_the_caller_until_the_end() -> None:
    cores = os.sched_getaffinity(0)
    if len(cores) < 2:
        pytest.skip("there is one core only")
    go_home = threading.Event()
    other = threading.Thread(target=go_home.wait)
    other.start()
    try:
        assert other.native_id is not None
        with own_core():
            mine, theirs = os.sched_getaffinity(threading.get_native_id()), os.sched_getaffinity(other.native_id)
        assert len(mine) == 1
        assert theirs == cores - mine
        assert os.sched_getaffinity(threading.get_native_id()) == cores
        assert os.sched_getaffinity(other.native_id) == cores
    finally:
        go_home.set()
        other.join()


@linux
def test_with_a_single_core_nothing_is_done() -> None:
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        with own_core():
            assert os.sched_getaffinity(0) == {min(cores)}
    finally:
        os.sched_setaffinity(0, cores)
