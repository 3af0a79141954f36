"""The thread that ticks keeps a core to itself, and gives it back."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import pytest

import trainer.own_core
from trainer.own_core import own_core

linux = pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells where a thread runs")


@contextmanager
def another_thread() -> Iterator[int]:
    """A thread that waits, as the system calls it."""
    go_home = threading.Event()
    other = threading.Thread(target=go_home.wait)
    other.start()
    try:
        assert other.native_id is not None
        yield other.native_id
    finally:
        go_home.set()
        other.join()


@pytest.fixture
def cores(monkeypatch: pytest.MonkeyPatch) -> set[int]:
    """Where the test may run, on more than one core. Sessions of other tests that run now have claims of their own."""
    monkeypatch.setattr(trainer.own_core, "CLAIM", f"test {os.getpid()}: core")
    found = os.sched_getaffinity(0)
    if len(found) < 2:
        pytest.skip("there is one core only")
    return found


@linux
def test_other_threads_keep_off_the_core_of_the_caller_until_the_end(cores: set[int]) -> None:
    with another_thread() as other:
        with own_core():
            mine, theirs = os.sched_getaffinity(threading.get_native_id()), os.sched_getaffinity(other)
        assert len(mine) == 1
        assert theirs == cores - mine
        assert os.sched_getaffinity(threading.get_native_id()) == cores
        assert os.sched_getaffinity(other) == cores


@linux
def test_a_process_beside_the_caller_keeps_off_its_core_too(cores: set[int]) -> None:
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as other:
        with own_core(other.pid):
            mine, theirs = os.sched_getaffinity(0), os.sched_getaffinity(other.pid)
        assert len(mine) == 1
        assert theirs == cores - mine
        assert os.sched_getaffinity(other.pid) == cores
        other.kill()
    with own_core(other.pid):  # which is gone
        assert os.sched_getaffinity(0) == mine


@linux
def test_a_thread_that_was_bound_is_bound_again_and_a_new_one_goes_where_the_caller_may(cores: set[int]) -> None:
    for home in cores:
        with another_thread() as bound, ExitStack() as stack:
            os.sched_setaffinity(bound, {home})
            with own_core():
                mine = os.sched_getaffinity(0)
                assert os.sched_getaffinity(bound) == ({home} if {home} != mine else cores - mine)
                new = stack.enter_context(another_thread())
            assert os.sched_getaffinity(bound) == {home}
            assert os.sched_getaffinity(new) == cores


@linux
def test_where_the_caller_cannot_be_bound_nothing_is_done(cores: set[int], monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a container whose cores were changed after the session asked for them."""
    really = os.sched_setaffinity

    def refused(thread: int, to: set[int]) -> None:
        if len(to) == 1:
            raise OSError(22, "Invalid argument")
        really(thread, to)

    monkeypatch.setattr(os, "sched_setaffinity", refused)
    with another_thread() as other, own_core():
        assert os.sched_getaffinity(other) == os.sched_getaffinity(0) == cores


OTHER_SESSION = """
import os, sys
import trainer.own_core
trainer.own_core.CLAIM = sys.argv[1]
with trainer.own_core.own_core():
    print(*os.sched_getaffinity(0), flush=True)
    sys.stdin.read()
"""


@linux
def test_sessions_take_different_cores_and_the_last_one_takes_none(cores: set[int]) -> None:
    """As many processes as there are cores get one each; one more may run on all; who ends gives its core back."""
    pair = set(sorted(cores)[-2:])
    session = [sys.executable, "-c", OTHER_SESSION, trainer.own_core.CLAIM]
    os.sched_setaffinity(0, pair)
    try:
        with own_core():
            mine = os.sched_getaffinity(0)
            os.sched_setaffinity(0, pair)  # the other process may run where this one may
            other = subprocess.Popen(session, stdin=-1, stdout=-1, text=True)
            with other:
                assert other.stdout is not None
                assert {int(core) for core in other.stdout.readline().split()} == pair - mine
                third = subprocess.run(session, input="", capture_output=True, text=True)
                assert {int(core) for core in third.stdout.split()} == pair
            again = subprocess.run(session, input="", capture_output=True, text=True)
            assert {int(core) for core in again.stdout.split()} == pair - mine
    finally:
        os.sched_setaffinity(0, cores)


@linux
def test_with_a_single_core_nothing_is_done() -> None:
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        with own_core():
            assert os.sched_getaffinity(0) == {min(cores)}
    finally:
        os.sched_setaffinity(0, cores)
