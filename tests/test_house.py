"""The rules of the house: who imports whom, what start-up costs, what a wheel holds, how long a file may be."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parent.parent
MODULES = sorted((ROOT / "trainer").rglob("*.py"))
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))

#: What each part of trainer/ may import of the others. Data first, then the simulation upwards, then what reads
#: the log: it never sees a scene, so a session can be scored on a machine that cannot simulate.
DATA = {"config", "curriculum", "data_files", "events", "geometry", "motion", "poses"}
MAY_IMPORT: dict[str, set[str]] = {
    "__init__": set(),
    "config": set(),
    "data_files": set(),
    "events": set(),
    "geometry": set(),
    "clock": set(),
    "own_core": set(),
    "serial_ports": set(),
    "image_header": {"config"},
    "openigtlink": {"geometry"},
    "poses": {"geometry"},
    "motion": {"config", "geometry"},
    "view": {"geometry", "poses"},
    "curriculum": {"config", "data_files"},
    "calibration": {"config"},
    "profile": {"calibration", "config", "data_files"},
    "choice": {"config", "curriculum", "data_files"},
    "mechanics": {"geometry"},
    "haptics": {"geometry", "mechanics"},
    "pictures": {"geometry", "mechanics"},
    "anatomy": {"config", "curriculum", "data_files", "geometry", "mechanics", "image_header"},
    "instruments": {"config", "curriculum", "geometry", "poses", "mechanics"},
    "interactions": DATA | {"mechanics", "anatomy", "instruments", "view"},
    "log": {"config", "events", "geometry", "poses"},
    "sinks": {"events", "geometry", "poses", "log", "openigtlink"},
    "showing": {"anatomy", "geometry", "interactions", "pictures", "sinks"},
    "snapshot": {"geometry", "interactions", "mechanics", "sinks"},
    "scene_rules": {"anatomy", "config", "curriculum", "geometry", "interactions"},
    "scene": DATA
    | {
        "mechanics",
        "anatomy",
        "instruments",
        "interactions",
        "scene_rules",
        "showing",
        "sinks",
        "snapshot",
        "view",
    },
    "drivers": DATA | {"calibration", "log", "image_header", "openigtlink", "profile", "view"},
    "simulators": DATA | {"drivers", "log", "profile"},
    "session": {"clock", "drivers", "events", "geometry", "poses", "scene", "sinks"},
    "resimulation": DATA | {"anatomy", "log", "scene"},
    "metrics": DATA | {"log"},
    "reporting": DATA | {"log", "metrics"},
    "exports": DATA | {"log", "metrics"},
    "bench": DATA
    | {
        "anatomy",
        "clock",
        "drivers",
        "haptics",
        "interactions",
        "mechanics",
        "profile",
        "reporting",
        "scene",
        "session",
    },
}
#: Too heavy to be imported before a command knows that it needs them.
HEAVY = {"numba", "numpy", "scipy", "rerun", "trimesh", "sqlite_utils", "rich"}


def part_of(module: Path) -> str:
    return module.relative_to(ROOT / "trainer").parts[0].removesuffix(".py")


def imported_parts(module: Path) -> set[str]:
    """The parts of trainer/ that a file imports, wherever in the file it does."""
    names: list[str] = []
    for node in ast.walk(ast.parse(module.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: relative import"
            names += [f"{node.module}.{alias.name}" for alias in node.names]
    return {name.split(".")[1] for name in names if name.startswith("trainer.")} - {"__version__"}


@pytest.mark.parametrize("module", MODULES, ids=lambda m: str(m.relative_to(ROOT)))
def test_imports_go_one_way(module: Path) -> None:
    part = part_of(module)
    if part in {"cli", "__main__"}:
        return
    assert part in MAY_IMPORT, f"say in MAY_IMPORT what trainer/{part} may import"
    assert imported_parts(module) - {part} <= MAY_IMPORT[part]


#: Ways to make an array in a kernel.
MAKERS = {
    "append", "arange", "argsort", "array", "astype", "concatenate", "copy", "empty", "empty_like", "flatnonzero",
    "full", "linspace", "nonzero", "ones", "sort", "stack", "unique", "where", "zeros", "zeros_like",
}  # fmt: skip
#: Kernels that run once for a topology, or once for a factor, and not at every tick.
PREPARE = {"nested_dissection", "multifrontal"}


def kernels(module: Path) -> list[ast.FunctionDef]:
    return [
        f
        for f in ast.walk(ast.parse(module.read_text(encoding="utf-8")))
        if isinstance(f, ast.FunctionDef) and any("njit" in ast.unparse(d) for d in f.decorator_list)
    ]


@pytest.mark.parametrize(
    "module",
    [m for m in MODULES if part_of(m) in {"mechanics", "interactions"} and m.stem not in PREPARE],
    ids=lambda m: m.stem,
)
def test_what_runs_at_every_tick_makes_no_array(module: Path) -> None:
    """A small array made in a kernel costs twelve times the work on it: kernels write to what they are given."""
    made = [
        f"{kernel.name}, line {call.lineno}: {ast.unparse(call)}"
        for kernel in kernels(module)
        for call in ast.walk(kernel)
        if isinstance(call, ast.List | ast.ListComp)
        or (isinstance(call, ast.Call) and isinstance(call.func, ast.Attribute) and call.func.attr in MAKERS)
    ]
    assert not made


def test_no_import_goes_in_a_circle() -> None:
    """The table itself has an order: each part comes after all that it may import."""
    placed: set[str] = set()
    waiting = dict(MAY_IMPORT)
    while waiting:
        ready = {part for part, needs in waiting.items() if needs <= placed}
        assert ready, f"a circle among {sorted(waiting)}"
        placed |= ready
        waiting = {part: needs for part, needs in waiting.items() if part not in ready}


def test_what_reads_the_log_never_sees_the_simulation() -> None:
    simulation = {"scene", "mechanics", "anatomy", "instruments", "interactions", "drivers", "session"}
    for part in ("metrics", "reporting", "exports", "log", "sinks"):
        assert not MAY_IMPORT[part] & simulation


@pytest.mark.parametrize("module", MODULES, ids=lambda m: str(m.relative_to(ROOT)))
def test_a_file_can_be_read_in_one_sitting(module: Path) -> None:
    """The house's rule is about 400 lines; a quarter more is the alarm."""
    assert len(module.read_text(encoding="utf-8").splitlines()) <= 500


def test_no_two_test_files_share_a_name() -> None:
    """They are imported by their names alone: of two that share one, the second would not be collected."""
    names = [path.name for path in (ROOT / "tests").rglob("test_*.py")]
    assert sorted(names) == sorted(set(names))


def started(arguments: list[str]) -> set[str]:
    """The top-level modules that a run of the command line has imported when it ends."""
    code = (
        "import sys\nfrom trainer.cli.main import main\n"
        "try:\n    main()\nexcept SystemExit as end:\n    assert not end.code, end.code\n"
        "print(' '.join({name.partition('.')[0] for name in sys.modules}), file=sys.stderr)"
    )
    command = [sys.executable, "-c", code, *arguments]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    return set(done.stderr.split())


@pytest.mark.parametrize(
    "arguments",
    [["--help"], ["practice", "--help"], ["sessions", "--help"], ["curricula", "list"], ["devices", "list"]],
    ids=" ".join,
)
def test_start_up_imports_nothing_heavy(arguments: list[str]) -> None:
    assert not started(arguments) & HEAVY


def test_the_version_is_told_without_importing_typer() -> None:
    assert not started(["--version"]) & (HEAVY | {"typer", "pydantic"})


def test_every_package_is_listed() -> None:
    found = {".".join(m.parent.relative_to(ROOT).parts) for m in MODULES}
    listed = {name for name in PYPROJECT["tool"]["setuptools"]["packages"] if "._data" not in name}
    assert listed == found


def test_the_lock_pins_every_dependency_with_hashes_and_names_no_address() -> None:
    lock = (ROOT / "requirements.lock").read_text(encoding="utf-8")
    assert not re.search(r"://|index-url|find-links|(?<!\w)/\w", lock)
    entries = re.findall(r"^([\w.-]+)==(\S+)( ; .*)? \\$", lock, flags=re.MULTILINE)
    pinned: dict[str, list[str]] = {}
    for name, version, _ in entries:
        pinned.setdefault(name, []).append(version)
    # The other extras are packages of devices, which `make` does not install.
    for text in [*PYPROJECT["project"]["dependencies"], *PYPROJECT["project"]["optional-dependencies"]["test"]]:
        wanted = Requirement(text)
        assert pinned.get(wanted.name), f"{wanted.name} is not locked: run `make lock`"
        assert all(wanted.specifier.contains(version) for version in pinned[wanted.name])
    assert lock.count("--hash=sha256:") >= len(entries)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel of a copy of this tree; building must not warn that something is left out."""
    copy = tmp_path_factory.mktemp("wheel") / "copy"
    copy.mkdir()
    for folder in ("trainer", "curricula", "devices", "reports"):
        shutil.copytree(ROOT / folder, copy / folder, ignore=shutil.ignore_patterns("__pycache__"))
    for file in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / file, copy)
    pip = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "--no-index"]
    done = subprocess.run([*pip, "-w", copy, copy], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "would be ignored" not in done.stderr
    return next(copy.glob("*.whl"))


def test_the_wheel_holds_all_code_and_data(wheel: Path) -> None:
    data = [
        *(ROOT / "curricula").rglob("*.toml"),
        *(ROOT / "devices").rglob("*.toml"),
        *(p for p in (ROOT / "reports" / "templates").rglob("*") if p.is_file()),
        ROOT / "reports" / "speed_error.json",
    ]
    expected = {m.relative_to(ROOT).as_posix() for m in MODULES}
    expected |= {p.relative_to(ROOT).as_posix() for p in (ROOT / "trainer" / "anatomy" / "data").rglob("*.toml")}
    expected |= {f"trainer/_data/{p.relative_to(ROOT).as_posix()}" for p in data}
    with zipfile.ZipFile(wheel) as archive:
        found = {name for name in archive.namelist() if ".dist-info/" not in name}
    assert found == expected


def test_the_installed_program_finds_its_data_from_any_folder(wheel: Path, tmp_path: Path) -> None:
    site = tmp_path / "site"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    code = "import sys; from trainer.data_files import data_folder; print(data_folder('curricula'))"
    environment = os.environ | {"PYTHONPATH": str(site)}

    def run(*arguments: str) -> str:
        command = [sys.executable, "-P", *arguments]
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
        return done.stdout

    assert Path(run("-c", code).strip()) == site / "trainer" / "_data" / "curricula"
    assert "anastomosis/single-stitch" in run("-m", "trainer", "curricula", "list")
    assert "scripted" in run("-m", "trainer", "devices", "list")
