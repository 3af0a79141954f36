"""Simulated devices in a process of their own, for tests: started, told apart by a profile, ended."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from waiting import PATIENCE_S

from trainer.drivers.minibird_flock import Silences
from trainer.profile import Profile, load_profile

#: Times faster than real time; the units' silences are shortened less, since a busy machine keeps no short ones, and an
#: answer that comes is waited for.
SPEED = 10.0
SHORT = Silences(reset_s=0.1, hold_s=0.05, configure_s=0.15, drain_s=0.05, answer_s=10.0)


@contextmanager
def simulated(folder: Path, *options: str, profile: str = "minibird-pair", speed: float = SPEED) -> Iterator[Path]:
    """``trainer devices simulate`` until the end of the block; the path of the profile that names its ports.

    It must end as it was asked to, say nothing on stderr, and never have been sent transmitter mode 0.
    """
    command = [sys.executable, "-m", "trainer", "devices", "simulate", profile]
    command += ["--out", str(folder), "--speed", str(speed), *options]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ)
    assert process.stdout is not None
    try:
        written = process.stdout.readline().strip()
        assert written, process.stderr.read() if process.stderr is not None else ""
        yield Path(written)
    finally:
        process.terminate()
        out, err = process.communicate(timeout=PATIENCE_S)
    assert err == ""
    assert process.returncode == 0
    assert json.loads(out)["transmitter_damaged"] is False


def loaded(path: Path) -> Profile:
    return load_profile(str(path)).profile
