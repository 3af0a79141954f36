"""What a recording holds, read back with rerun's own tools, and what happens when it cannot be written."""

from __future__ import annotations

import dataclasses
import itertools
import os
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun_cli
from rerun.chunk import RrdReader
from stitch_frames import METRICS, TOOLS, frame, header, layout, made_up_events, packed, records, unpacked
from waiting import wait_for

from trainer import events
from trainer.log.repair import repair_command
from trainer.sinks import recording
from trainer.sinks.recorder import NICER, NORMAL_STEP, VERTEX_STEP_MM
from trainer.sinks.recording import RecorderProcess, RecordingSink
from trainer.sinks.rrd_file import RecordingError
from trainer.sinks.surface import TickRecord

TICKS = 150
HZ = 100.0
#: 100 Hz cannot be thinned to 30 Hz by a whole number of ticks; the next slower rate is 25 Hz.
TICKS_PER_FRAME = 4
#: Positions of instruments and needle are stored as float32: |x| < 16 mm gives 16 · 2^-24.
FLOAT32_MM = 16 * 2.0**-24

ROOT = Path(__file__).parents[2]
CLI = Path(rerun_cli.__file__).with_name("rerun")


def rrd(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [str(CLI), "rrd", *map(str, arguments)]
    quiet = os.environ | {"RERUN_APP_ONLY": "1"}  # no word about usage data on a first run
    return subprocess.run(command, capture_output=True, text=True, check=False, env=quiet)


def record_to(path: Path, session: Iterable[TickRecord], **options: Any) -> RecordingSink:
    sink = RecordingSink(path, header(), layout(), HZ, **options)
    for tick in session:
        sink.tick(tick)
    sink.metrics(METRICS)
    sink.close()
    return sink


def rows(path: Path, entity: str, component: str) -> dict[int | None, Any]:
    """The values of a component by tick; None is the key of a static value."""
    found: dict[int | None, Any] = {}
    for chunk in RrdReader(path).stream().filter(content=[f"/{entity}"]).to_chunks():
        batch = chunk.to_record_batch()
        if component in batch.schema.names:
            ticks = batch.column("tick").to_pylist() if "tick" in batch.schema.names else [None] * len(batch)
            values = batch.column(component).to_pylist()
            found.update({t: v for t, v in zip(ticks, values, strict=True) if v is not None})
    return dict(sorted(found.items(), key=lambda item: -1 if item[0] is None else item[0]))


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "stitch.rrd"
    sink = record_to(path, records(TICKS), realtime=False)
    assert sink.error is None
    assert sink.dropped_frames == 0
    return path


def test_reruns_own_check_accepts_the_file(path: Path) -> None:
    done = rrd("verify", path)
    assert done.returncode == 0, done.stderr


def test_frames_come_at_most_30_times_a_second_and_the_last_tick_has_one(path: Path) -> None:
    ticks = list(rows(path, "world/vessel/A", "Mesh3D:vertex_positions"))
    assert ticks == [*range(0, TICKS, TICKS_PER_FRAME), TICKS]


@pytest.mark.parametrize("surface", [0, 1])
def test_no_static_vertex_shadows_the_moving_ones(path: Path, surface: int) -> None:
    """A static value hides all values in time from the viewer, without a warning."""
    entity = f"world/{layout().surfaces[surface].name}"
    assert None in rows(path, entity, "Mesh3D:triangle_indices")
    assert None not in rows(path, entity, "Mesh3D:vertex_positions")
    assert None not in rows(path, entity, "Mesh3D:vertex_normals")
    assert None not in rows(path, "world/thread", "LineStrips3D:strips")


def test_vertices_are_those_of_the_frame_within_half_a_step(path: Path) -> None:
    """Rounding to the nearest multiple errs by at most half a step; float32 holds the multiple exactly."""
    for surface, s in enumerate(layout().surfaces):
        stored = rows(path, f"world/{s.name}", "Mesh3D:vertex_positions")
        for tick, values in stored.items():
            assert tick is not None
            error = np.asarray(values, dtype=np.float64) - frame(tick, TICKS).vertices[surface]
            assert np.abs(error).max() <= 0.5 * VERTEX_STEP_MM


def test_normals_have_length_one_and_point_out_of_the_outer_hull(path: Path) -> None:
    """Each component errs by at most half a step, the length by at most √3 of it."""
    stored = rows(path, "world/vessel/A", "Mesh3D:vertex_normals")
    vertices = rows(path, "world/vessel/A", "Mesh3D:vertex_positions")
    normals = np.asarray(stored[0], dtype=np.float64)
    assert np.abs(np.linalg.norm(normals, axis=1) - 1.0).max() <= np.sqrt(3.0) * 0.5 * NORMAL_STEP
    middle = slice(24 * 8, 24 * 12)  # layers of the outer hull away from both ends
    assert np.all(np.sum(normals[middle, 1:] * np.asarray(vertices[0])[middle, 1:], axis=1) > 0.0)


def test_needle_thread_and_instruments_are_where_the_frame_says(path: Path) -> None:
    needle = rows(path, "world/needle", "Transform3D:translation")
    turn = rows(path, "world/needle", "Transform3D:quaternion")
    strips = rows(path, "world/thread", "LineStrips3D:strips")
    blades = [rows(path, f"world/instruments/{p.name}", "Transform3D:translation") for p in layout().parts]
    blade_turns = [rows(path, f"world/instruments/{p.name}", "Transform3D:quaternion") for p in layout().parts]
    assert len(needle) == len(strips) == len(blades[0])
    for tick in needle:
        assert tick is not None
        expected = frame(tick, TICKS)
        assert expected.needle_quaternion is not None
        np.testing.assert_allclose(needle[tick][0], expected.needle_position, atol=FLOAT32_MM)
        np.testing.assert_allclose(np.roll(turn[tick][0], 1), expected.needle_quaternion, atol=FLOAT32_MM)
        assert len(strips[tick]) == len(expected.thread)
        for stored, piece in zip(strips[tick], expected.thread, strict=True):
            assert np.abs(np.asarray(stored, dtype=np.float64) - piece).max() <= 0.5 * VERTEX_STEP_MM
        for k in range(len(blades)):
            np.testing.assert_allclose(blades[k][tick][0], expected.part_position[k], atol=FLOAT32_MM)
            np.testing.assert_allclose(
                np.roll(blade_turns[k][tick][0], 1), expected.part_quaternion[k], atol=FLOAT32_MM
            )


def test_a_broken_thread_is_drawn_in_pieces_and_no_thread_as_none(tmp_path: Path) -> None:
    def cut(tick: TickRecord) -> TickRecord:
        whole = unpacked(tick.snapshot())
        pieces = ((whole.thread[0][:40], whole.thread[0][40:]), ())[tick.tick % 2]
        return dataclasses.replace(tick, snapshot=lambda: packed(dataclasses.replace(whole, thread=pieces)))

    path = tmp_path / "cut.rrd"
    sink = RecordingSink(path, header(), layout(), tick_hz=30.0, realtime=False)
    for tick in map(cut, records(3)):
        sink.tick(tick)
    sink.close()
    strips = rows(path, "world/thread", "LineStrips3D:strips")
    assert [[len(piece) for piece in strips[t]] for t in range(4)] == [[40, 61], [], [40, 61], []]


def test_every_event_is_in_the_log_at_its_own_time_with_its_level(path: Path) -> None:
    found = []
    for chunk in RrdReader(path).stream().filter(content=["/events"]).to_chunks():
        batch = chunk.to_record_batch()
        columns = [batch.column(c).to_pylist() for c in ("tick", "sim_time", "TextLog:text", "TextLog:level")]
        found += [(t, s.total_seconds(), text[0], level[0]) for t, s, text, level in zip(*columns, strict=True)]
    found.sort(key=lambda row: row[0])  # stable: rows of one tick stay in the file's order
    expected = made_up_events(TICKS, HZ)
    assert len(found) == len(expected)
    for (tick, time_s, text, level), event in zip(found, expected, strict=True):
        assert tick == event.tick
        assert time_s == pytest.approx(event.time_s, abs=1e-6)  # Python reads microseconds
        assert text.split()[0] == event.kind
        assert level == {"tear": "ERROR", "overforce": "WARN"}.get(event.kind, "INFO")


def test_lanes_show_the_step_and_what_a_hand_holds(path: Path) -> None:
    steps = rows(path, "state/step", "StateChange:state")
    assert [v[0] for v in steps.values()] == ["through the wall of A", "pull the thread through", "completed"]
    held = rows(path, "state/right", "StateChange:state")
    assert list(held.values()) == [["needle"], []]


def test_scores_are_scalars_and_a_table(path: Path) -> None:
    for metric in METRICS:
        values = rows(path, f"metrics/{metric.name}", "Scalars:scalars")
        assert values == ({} if metric.value is None else {TICKS: [metric.value]})
    table = rows(path, "scores", "TextDocument:text")[None][0]
    assert all(m.name in table and m.source in table for m in METRICS)


def test_closure_and_forces_are_there_for_each_frame(path: Path) -> None:
    for k, tool in enumerate(TOOLS):
        values = rows(path, f"closure/{tool}", "Scalars:scalars")
        poses = {r.tick: r.poses.closure[k] for r in records(TICKS)}
        assert all(value == [poses[tick]] for tick, value in values.items() if tick is not None)
    tension = rows(path, "force/thread", "Scalars:scalars")
    assert all(value == [frame(t, TICKS).tension_mN] for t, value in tension.items() if t is not None)


def test_the_file_does_not_say_who_it_was(path: Path) -> None:
    assert header().trainee.encode() not in path.read_bytes()


def test_the_same_session_gives_the_same_recording_and_another_does_not(path: Path, tmp_path: Path) -> None:
    """Rows leave rerun in no fixed order, hence --unordered; everything else must agree, chunk by chunk."""
    again, other = tmp_path / "again.rrd", tmp_path / "other.rrd"
    record_to(again, records(TICKS), realtime=False)
    same = rrd("compare", "--unordered", path, again)
    assert same.returncode == 0, same.stderr

    def moved() -> Iterator[TickRecord]:
        for tick in records(TICKS):
            shown = unpacked(tick.snapshot())
            if tick.tick == 100:
                shown.vertices[1][7, 2] += VERTEX_STEP_MM
            yield dataclasses.replace(tick, snapshot=lambda shown=shown: packed(shown))

    record_to(other, moved(), realtime=False)
    assert rrd("compare", "--unordered", path, other).returncode == 1


def test_in_real_time_frames_are_dropped_and_events_are_not(tmp_path: Path) -> None:
    """While the process stands still, the frames that its pipe holds are taken; every event still arrives."""
    path = tmp_path / "slow.rrd"
    sink = RecordingSink(path, header(), layout(), tick_hz=30.0)
    os.kill(sink.pid, signal.SIGSTOP)
    first = next(records(1))
    frames = 3 * recording.PIPE_BYTES // first.snapshot().nbytes
    for k in range(frames):
        slip = events.Slip(k, 0, k / 30.0, "left", target="thread", body="", load_mN=2.0, limit_mN=1.0)
        sink.tick(dataclasses.replace(first, tick=k, time_s=k / 30.0, events=(slip,)))
    assert sink.waiting > sink.dropped_frames > 0  # the event that came with a frame that was dropped, and one in parts
    os.kill(sink.pid, signal.SIGCONT)
    sink.close()
    assert list(rows(path, "events", "TextLog:text")) == list(range(frames))
    taken = list(range(frames - sink.dropped_frames))
    assert list(rows(path, "world/vessel/A", "Mesh3D:vertex_positions")) == taken


@pytest.mark.parametrize("name", ["missing/folder/x.rrd", "."])
def test_a_path_that_cannot_be_written_is_one_clear_line(tmp_path: Path, name: str) -> None:
    with pytest.raises(RecordingError) as caught:
        RecordingSink(tmp_path / name, header(), layout(), HZ)
    assert str(tmp_path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_recording_of_a_session_that_began_at_the_same_time_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "x.rrd"
    path.write_bytes(b"of another")
    with pytest.raises(RecordingError, match="File exists"):
        RecordingSink(path, header(), layout(), HZ)
    assert path.read_bytes() == b"of another"


FULL_DISK = """
import resource, sys
from pathlib import Path
from stitch_frames import header, layout, records
from trainer.sinks.recording import RecordingError, RecordingSink

resource.setrlimit(resource.RLIMIT_FSIZE, (400_000, 400_000))
sink = RecordingSink(Path(sys.argv[1]), header(), layout(), 100.0, realtime=False)
ticks = 0
for record in records(600):
    sink.tick(record)
    ticks += 1
try:
    sink.close()
except RecordingError as error:
    print(ticks, sink.error is error, error)
"""

SESSION = """
import sys, time
from pathlib import Path
from stitch_frames import header, layout, records
from trainer.sinks.recording import RecordingSink

sink = RecordingSink(Path(sys.argv[1]), header(), layout(), 100.0, realtime=False)
for record in records(1000):
    if record.tick > 650:
        break
    sink.tick(record)
assert not {"rerun", "rerun_bindings", "pyarrow"} & set(sys.modules)
print(sink.pid, flush=True)
time.sleep(600)
"""


def child_environment() -> dict[str, str]:
    return os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(Path(__file__).parent)])}


def test_a_full_disk_costs_the_recording_and_nothing_else(tmp_path: Path) -> None:
    """The session runs to its end, close says why, the process ends by itself, and the file can be repaired."""
    path, mended = tmp_path / "full.rrd", tmp_path / "mended.rrd"
    done = subprocess.run(
        [sys.executable, "-c", FULL_DISK, str(path)],
        env=child_environment(), capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.strip() == f"601 True {path}: cannot write the recording: File too large"
    assert path.stat().st_size == 400_000
    assert rrd("optimize", path, "-o", mended).returncode == 0
    assert rrd("verify", mended).returncode == 0
    assert rows(mended, "world/vessel/A", "Mesh3D:vertex_positions")


@contextmanager
def session(path: Path) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """Another process that has ticked up to 650 and now waits, without rerun; and the one that writes for it."""
    child = subprocess.Popen(
        [sys.executable, "-c", SESSION, str(path)], env=child_environment(), stdout=subprocess.PIPE, text=True
    )
    try:
        assert child.stdout is not None
        yield child, int(child.stdout.readline())
    finally:
        child.kill()
        child.communicate()


def test_the_recording_of_a_killed_session_is_whole_up_to_the_last_tick(tmp_path: Path) -> None:
    path = tmp_path / "killed.rrd"
    with session(path) as (child, recorder):
        assert repair_command(path)
        child.kill()
        assert wait_for(lambda: repair_command(path) == "")
        assert wait_for(lambda: has_ended(recorder))
    assert rrd("verify", path).returncode == 0
    ticks = list(rows(path, "world/vessel/A", "Mesh3D:vertex_positions"))
    assert ticks == list(range(0, 651, TICKS_PER_FRAME))


def test_where_all_is_killed_one_command_repairs_the_recording(tmp_path: Path) -> None:
    """All up to the last flush is there: they come after 0, 1, 2, 4 and 8 s, so that at tick 650 tick 400 was it."""
    path = tmp_path / "killed.rrd"
    with session(path) as (_, recorder):
        wait_until_it_holds(400 - TICKS_PER_FRAME, path)
        os.kill(recorder, signal.SIGKILL)
    assert rrd("verify", path).returncode == 1
    ticks = list(rows(repaired(path, repair_command(path)), "world/vessel/A", "Mesh3D:vertex_positions"))
    assert ticks[: 400 // TICKS_PER_FRAME] == list(range(0, 400, TICKS_PER_FRAME))


@pytest.mark.parametrize("realtime", [False, True])
def test_a_recorder_that_is_killed_costs_no_tick_and_the_line_says_what_to_do(tmp_path: Path, realtime: bool) -> None:
    path = tmp_path / "alone.rrd"
    sink = RecordingSink(path, header(), layout(), HZ, realtime=realtime)
    for record in records(TICKS):
        if record.tick == 100:
            assert sink.error is None
            os.kill(sink.pid, signal.SIGKILL)
        sink.tick(record)
    sink.metrics(METRICS)
    with pytest.raises(RecordingError) as caught:
        sink.close()
    line, _, repair = str(caught.value).partition("; repair what is there with: ")
    assert line == f"{path}: cannot write the recording: the process that writes it ended by SIGKILL"
    repaired(path, repair)
    assert not Path(f"/proc/{sink.pid}").exists()


class OutOfMemory:
    """What raises an error without a text where it is read."""

    def __reduce__(self) -> tuple[object, ...]:
        return exec, ("raise MemoryError",)


def test_a_failure_that_says_nothing_is_a_failure(tmp_path: Path) -> None:
    recorder = RecorderProcess()
    sink = RecordingSink(tmp_path / "x.rrd", header(), layout(), HZ, realtime=False, recorder=recorder)
    recorder.send(OutOfMemory())  # type: ignore[arg-type]
    with pytest.raises(RecordingError, match=r"cannot write the recording: MemoryError$"):
        sink.close()


def test_a_message_that_was_interrupted_is_not_sent_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A second Ctrl-C may come when the pipe has taken a part of one: the file ends before it, and that is told."""
    path = tmp_path / "x.rrd"
    sink = RecordingSink(path, header(), layout(), HZ, realtime=False)
    first, second = itertools.islice(records(10), 2)
    sink.tick(first)

    def half(pipe: int, pieces: list[memoryview], write: Callable[[int, memoryview], int] = os.write) -> int:
        write(pipe, pieces[0])
        write(pipe, pieces[1][: len(pieces[1]) // 2])
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(recording.os, "writev", half)
        with pytest.raises(KeyboardInterrupt):
            sink.tick(dataclasses.replace(first, tick=TICKS_PER_FRAME, events=second.events))
    with pytest.raises(RecordingError, match=r"cannot write the recording: it was interrupted; its end is missing$"):
        sink.close()
    assert wait_for(lambda: has_ended(sink.pid))
    assert rrd("verify", path).returncode == 0
    assert list(rows(path, "world/vessel/A", "Mesh3D:vertex_positions")) == [0]


def test_ctrl_c_is_none_of_the_recorders_business(tmp_path: Path) -> None:
    """It is in no group that a terminal interrupts, and goes on if the signal reaches it all the same."""
    path = tmp_path / "interrupted.rrd"
    sink = RecordingSink(path, header(), layout(), HZ, realtime=False)
    assert os.getpgid(sink.pid) == sink.pid != os.getpgid(0)
    # The system weighs nice processes against those of the same session only.
    assert os.getsid(sink.pid) == os.getsid(0)
    assert os.getpriority(os.PRIO_PROCESS, sink.pid) == min(19, os.getpriority(os.PRIO_PROCESS, 0) + NICER)
    for record in records(20):
        os.kill(sink.pid, signal.SIGINT)
        sink.tick(record)
    sink.close()
    assert rrd("verify", path).returncode == 0


@pytest.mark.skipif(sys.platform != "linux", reason="what a process has is counted in /proc")
def test_a_session_leaves_nothing_behind(tmp_path: Path) -> None:
    """No process, no thread, no open file: of a recording, of one that failed, and of a session that was refused."""

    def there() -> tuple[int, int]:
        return len(os.listdir("/proc/self/task")), len(os.listdir("/proc/self/fd"))

    before = there()
    whole = record_to(tmp_path / "whole.rrd", records(8))
    failed = RecordingSink(tmp_path / "failed.rrd", header(), layout(), HZ)
    os.kill(failed.pid, signal.SIGKILL)
    with pytest.raises(RecordingError):
        failed.close()
    refused = RecorderProcess()
    refused.close()
    gone = RecorderProcess()
    os.kill(gone.pid, signal.SIGKILL)
    with pytest.raises(RecordingError, match=r"the process that writes it ended by SIGKILL$"):
        RecordingSink(tmp_path / "never.rrd", header(), layout(), HZ, recorder=gone)
    assert there() == before
    for process in (whole, failed, refused, gone):
        assert not Path(f"/proc/{process.pid}").exists()


def has_ended(process: int) -> bool:
    """It is gone, or waits for whoever has inherited it to notice."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


def repaired(path: Path, command: str) -> Path:
    """The file that a command makes which was told to repair ``path``; rerun accepts it."""
    mended = path.with_suffix(".repaired.rrd")
    subprocess.run(shlex.split(command), capture_output=True, check=True)
    assert rrd("verify", mended).returncode == 0
    return mended


def wait_until_it_holds(tick: int, path: Path) -> None:
    """What the recorder has written is on its way to the file through a pipe."""
    copy = path.with_suffix(".copy.rrd")

    def there() -> bool:
        shutil.copy(path, copy)
        return tick in rows(repaired(copy, repair_command(copy)), "world/vessel/A", "Mesh3D:vertex_positions")

    assert wait_for(there)
