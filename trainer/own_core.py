"""A core of its own for the thread that ticks.

Where more threads are busy than cores, a system lets them take turns, and a turn is long: Linux keeps a tick's thread
waiting for 4 ms while another has its core (measured; a nicer thread takes the same turn, less often). So in real time
all other threads of the process keep off one core, those of the process that writes its recording, too, and several
sessions on one machine take different ones. Only Linux lets a process say so; elsewhere, where there is a single core
and where every core is another session's, nothing is done.
"""

from __future__ import annotations

import os
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

#: What a session's claim on a core is called in the system's table of local sockets; the core's number follows.
CLAIM = "trainer: a tick has core"


@contextmanager
def own_core(*beside: int) -> Iterator[None]:
    """The calling thread has a core to itself, as far as processes that ask here go; threads that exist keep off it,
    in this process and in those ``beside`` it, by their ids.

    A thread that the caller starts meanwhile begins on the same core. In the end each thread may run again where it
    could before, and those that are new where the caller may.
    """
    taken = _take_core()
    if taken is None:
        yield
        return
    core, claim = taken
    here = threading.get_native_id()
    before = {here: os.sched_getaffinity(here)}
    with claim:
        try:
            with suppress(OSError):  # where the system does not let the caller, the others stay where they are
                os.sched_setaffinity(here, {core})
                _keep_off(core, before, beside)
            yield
        finally:
            for thread in _threads(beside):
                with suppress(OSError):  # it has just ended, or its cores are gone
                    os.sched_setaffinity(thread, before.get(thread, before[here]))


def _keep_off(core: int, before: dict[int, set[int]], beside: tuple[int, ...]) -> None:
    """All threads that ``before`` does not know keep off a core; it then knows where they could run until now."""
    for thread in _threads(beside):
        if thread not in before:
            with suppress(OSError):  # it has just ended
                cores = os.sched_getaffinity(thread)
                # Who was bound to that very core goes to the others meanwhile.
                os.sched_setaffinity(thread, cores - {core} or set.union(*before.values()) - {core})
                before[thread] = cores


def _threads(beside: tuple[int, ...]) -> list[int]:
    found = []
    for process in (os.getpid(), *beside):
        with suppress(OSError):  # it has ended
            found += [int(name) for name in os.listdir(f"/proc/{process}/task")]
    return found


def _take_core() -> tuple[int, socket.socket] | None:
    """The last core of the caller's that no other session has, and what holds it until it is closed; None without.

    The claim is a name in the system's own table of local sockets: all users see it, it needs no file, and it goes
    with the process however that ends. The first cores have most of a system's own work to do.
    """
    if sys.platform != "linux":
        return None
    cores = os.sched_getaffinity(threading.get_native_id())
    for core in sorted(cores, reverse=True) if len(cores) > 1 else []:
        claim = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            claim.bind(f"\0{CLAIM} {core}")
        except OSError:
            claim.close()
        else:
            return core, claim
    return None
