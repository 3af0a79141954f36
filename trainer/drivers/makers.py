"""Libraries of devices' makers, or for them: optional packages that may be missing, print, and raise what they like."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from types import ModuleType

from trainer.config import ConfigError
from trainer.drivers.serial_port import DeviceError


def library(module: str, package: str) -> ModuleType:
    """A module of an optional package. Raises ConfigError that says how to get it."""
    try:
        return importlib.import_module(module)
    except ImportError:
        raise ConfigError(f"this device needs a package that is not installed: pip install {package}") from None


@contextmanager
def failures(device: str) -> Iterator[None]:
    """Whatever the library raises inside becomes a DeviceError of one line that names the device."""
    try:
        yield
    except DeviceError:
        raise
    except Exception as error:  # there is no list of what they raise
        why = " ".join(str(error).split()) or type(error).__name__
        raise DeviceError(f"{device}: {why}") from None


@contextmanager
def stdout_kept() -> Iterator[None]:
    """What is printed inside, by child processes too, goes to stderr: stdout is for the program's own answers.

    For the whole process, so only the thread that prints the answers may use it, around all that others do meanwhile.
    """
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        with redirect_stdout(sys.stderr):
            yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
