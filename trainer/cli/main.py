"""``trainer``: one sub-command per noun, and the one place where an error becomes a line.

Nothing heavy is imported here: the commands import what they need when they run.
"""

from __future__ import annotations

import os
import stat
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import typer

#: The exit code of Ctrl-C, the shell's and typer's.
INTERRUPTED = 130


def main() -> None:
    """Run the command line; exit code 0 done, 1 failed with a line on stderr, 2 wrong usage, 130 Ctrl-C."""
    _open_closed_streams()
    try:
        try:
            _run()
        finally:
            sys.stdout.flush()  # here, where a reader that has gone can still be told from a fault
    except BrokenPipeError:
        # `trainer sessions list | head -1`: nothing is left to say, also not when the interpreter flushes.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except KeyboardInterrupt:
        print("trainer: interrupted", file=sys.stderr)
        sys.exit(INTERRUPTED)
    except Exception as error:
        if os.environ.get("TRAINER_DEBUG") or not _meant_for_people(error):
            raise
        sys.exit(f"trainer: {_one_line(error)}")


def _run() -> None:
    if sys.argv[1:] == ["--version"]:
        from trainer import __version__

        print(f"trainer {__version__}")
        return
    try:
        build_app()(prog_name="trainer")
    except SystemExit as end:
        if end.code == INTERRUPTED:
            raise KeyboardInterrupt from None
        raise


def _open_closed_streams() -> None:
    """Give what the caller has closed (``>&-``) to nobody, before a file takes its number and hears what we print."""
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:
            number = os.open(os.devnull, os.O_RDWR)
            os.set_inheritable(number, True)  # the same goes for processes that we start
            setattr(sys, name, os.fdopen(number, "r" if name == "stdin" else "w"))


def keep_kernels() -> None:
    """Have numba keep compiled kernels in the user's cache, unless NUMBA_CACHE_DIR already says where.

    The folder of an installed package may not be writable; where the user's cache is not either, a temporary
    folder serves. Must run before numba is imported.
    """
    if "NUMBA_CACHE_DIR" not in os.environ:
        from platformdirs import user_cache_path

        folder = user_cache_path("trainer") / "kernels"
        os.environ["NUMBA_CACHE_DIR"] = str(folder if _can_keep(folder) else _temporary_folder())


def _can_keep(folder: Path) -> bool:
    """Whether files can be made in a folder; without a home its path is not even absolute."""
    if not folder.is_absolute():
        return False
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK | os.X_OK)


def _temporary_folder() -> Path:
    """A folder that is this user's alone: whoever can write there decides what numba runs."""
    import tempfile

    if sys.platform == "win32":  # where the temporary files are the user's own
        return Path(tempfile.gettempdir()) / "trainer-kernels"
    folder = Path(tempfile.gettempdir()) / f"trainer-kernels-{os.getuid()}"
    try:
        folder.mkdir(mode=0o700)
    except FileExistsError:
        found = folder.lstat()
        if (found.st_uid, found.st_mode) != (os.getuid(), stat.S_IFDIR | 0o700):
            return Path(tempfile.mkdtemp(prefix="trainer-kernels-"))
    return folder


def build_app() -> typer.Typer:
    """The command line with all its sub-commands."""
    import typer

    from trainer.cli import anatomy, bench, curricula, db, devices, export, report, sessions
    from trainer.cli.practice import practice
    from trainer.cli.warmup import warmup

    app = typer.Typer(
        help="Training and assessment of surgical skill.",
        no_args_is_help=True,
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
        add_completion=False,
    )
    app.callback()(keep_kernels)
    app.command()(practice)
    app.add_typer(curricula.app, name="curricula")
    app.add_typer(sessions.app, name="sessions")
    app.add_typer(report.app, name="report")
    app.add_typer(export.app, name="export")
    app.add_typer(devices.app, name="devices")
    app.add_typer(anatomy.app, name="anatomy")
    app.add_typer(db.app, name="db")
    app.add_typer(bench.app, name="bench")
    app.command()(warmup)
    return app


def _meant_for_people(error: Exception) -> bool:
    """Errors that our own code raises on purpose (ConfigError and its like), and the operating system's."""
    return isinstance(error, OSError) or type(error).__module__.startswith("trainer.")


def _one_line(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror is not None:
        return error.strerror if error.filename is None else f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split())
