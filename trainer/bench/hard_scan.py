"""Hard cases of scans and of the maps that say what their labels are.

The law in all of them: what is wrong is refused in one line, and what is right gives the same labels in the same
place, whatever type and file keep them. The built-in knee stands for a scan.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from trainer.anatomy import inspection, knee, label_map, volume_file
from trainer.anatomy.label_volume import write_nrrd
from trainer.anatomy.structures import structures
from trainer.config import ConfigError
from trainer.geometry import Array

Run = Callable[[], str]
#: Voxels of the knee, mm.
VOXEL_MM = 2.0


def cases() -> list[tuple[str, str, Run]]:
    """(case, method, run). ``run`` answers "ok: …" or "refused: …"; AssertionError says that a law is broken."""
    exchanged = {"femur": "tibia", "tibia": "femur"}
    kinds = (("int8", "NRRD"), ("uint16", "NRRD"), ("float32", "NRRD"), ("uint16", "NIfTI"), ("float32", "NIfTI"))
    return [
        *((f"labels kept as {kind}", name, partial(kept_as, kind, name)) for kind, name in kinds),
        ("labels kept as float32, one a half", "NRRD", partial(bad_labels, 0.5)),
        ("labels kept as int8, one below 0", "NRRD", partial(bad_labels, -1)),
        ("spacing that is nan", "NRRD", nan_spacing),
        *(("file cut short", name, partial(cut_short, name)) for name in ("NRRD", "NIfTI")),
        *(("file of four dimensions", name, partial(four_dimensions, name)) for name in ("NRRD", "NIfTI")),
        ("label map with femur and tibia exchanged", "import", partial(mapped, exchanged)),
        ("label map with three labels that are not in the scan", "import", partial(mapped, {}, more=(201, 202, 203))),
        ("left and right exchanged, the map says which knee", "import", partial(exchanged_sides, "right")),
        ("left and right exchanged, the map says nothing", "import", partial(exchanged_sides, "")),
    ]


def _write(kind: str, path: Path, values: np.ndarray, directions: Array) -> None:
    """``values`` in a file of a kind; ``directions`` (3, 3) mm, LPS, has a column for each of the first axes."""
    if kind == "NIfTI":
        import nibabel

        affine = np.eye(4)
        affine[:3, :3] = np.diag((-1.0, -1.0, 1.0)) @ directions
        nibabel.save(nibabel.Nifti1Image(values, affine), path)  # type: ignore[no-untyped-call]
    else:
        import nrrd

        axes = [*directions.T, *[np.full(3, np.nan)] * (values.ndim - 3)]
        header = {"space": "left-posterior-superior", "space directions": axes, "space origin": np.zeros(3)}
        nrrd.write(str(path), values, header)


def _some_labels() -> np.ndarray:
    """Labels (7, 6, 5) from 0 to 4 whose every axis and direction differs."""
    return (np.arange(210).reshape(7, 6, 5) % 5).astype(np.uint8)


def _from_file(kind: str, values: np.ndarray, directions: Array, spoil: Callable[[Path], None] | None = None) -> str:
    """What becomes of a file: "ok: …" with its labels, or refused."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / {"NRRD": "scan.nrrd", "NIfTI": "scan.nii"}[kind]
        _write(kind, path, values, directions)
        if spoil is not None:
            spoil(path)
        try:
            found = volume_file.read(path)
        except ConfigError as error:
            return _one_line(error, folder)
        assert np.array_equal(found.values, values), "the labels are not those that were written"
        assert np.allclose(found.lps_from_index[:3, :3], directions), "the axes are not those that were written"
        return f"ok: {found.values.dtype}, labels {found.values.min()} to {found.values.max()}, axes as written"


def kept_as(kind: str, name: str) -> str:
    return _from_file(name, _some_labels().astype(kind), np.diag((0.5, 0.6, 0.8)))


def bad_labels(odd: float) -> str:
    values = _some_labels().astype(np.float32 if odd % 1 else np.int8)
    values[3, 2, 1] = odd
    return _from_file("NRRD", values, np.eye(3))


def nan_spacing() -> str:
    return _from_file("NRRD", _some_labels(), np.diag((0.5, np.nan, 0.8)))


def cut_short(name: str) -> str:
    return _from_file(name, _some_labels(), np.eye(3), _shorten)


def _shorten(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-20])


def four_dimensions(name: str) -> str:
    return _from_file(name, np.stack([_some_labels()] * 2, axis=3), np.eye(3))


def mapped(exchanged: dict[str, str], side: str = "", mirrored: bool = False, more: tuple[int, ...] = ()) -> str:
    """The built-in knee as a scan, by a map that exchanges structures, or has ``more`` labels than the scan."""
    volume = knee.build(knee.load("knee"), VOXEL_MM)
    present = set(volume.volumes_ml())
    names = {s.number: name for name, s in structures().items() if s.number in present}
    labels = {str(n): exchanged.get(name, name) for n, name in names.items()} | {str(n): "ignored" for n in more}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scan.nrrd"
        write_nrrd(volume, path)
        if mirrored:
            file = volume_file.read(path)
            _write("NRRD", path, file.values, np.diag((-1.0, 1.0, 1.0)) @ file.lps_from_index[:3, :3])
        file = volume_file.read(path)
        given = label_map.parse({"labels": labels} | ({"side": side} if side else {}), "labels.toml")
        found = inspection.regions(file)
        try:
            inspection.check(file, found, given)
        except ConfigError as error:
            return _one_line(error, folder)
        return f"ok: taken for a {inspection.side(found, given)} knee"


def exchanged_sides(side: str) -> str:
    """A mirrored right knee is a left one: only a map that says which it is can tell that the file is wrong."""
    return mapped({}, side, mirrored=True)


def _one_line(error: ConfigError, folder: str) -> str:
    assert "\n" not in str(error), "the message has more than one line"
    return f"refused: {str(error).replace(folder + '/', '')}"
