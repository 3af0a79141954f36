"""An imported knee: a folder with everything that a scene needs of a scan, and where it came from.

``labels.nrrd`` has the structures under our numbers, axes sorted; ``surfaces/*.ply`` one closed surface each, in the
volume's frame; ``anatomy.json`` is the record of origin: the file and its hash, its axes, which label became what,
and the version of the program that did it.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from trainer import __version__
from trainer.anatomy import inspection, label_map, surfaces, volume_file
from trainer.anatomy.label_volume import LabelVolume, resample, sorted_axes, write_nrrd
from trainer.anatomy.ligaments import swept_cruciates
from trainer.anatomy.structures import structures
from trainer.config import ConfigError

LABELS = "labels.nrrd"
RECORD = "anatomy.json"
SURFACES = "surfaces"


@dataclass(frozen=True)
class Anatomy:
    """A knee that a scene can be made of."""

    name: str
    volume: LabelVolume
    side: str  # left, right, or "" where nothing tells
    reference: str  # what finds it again: a built-in knee's name, or the whole path of a folder


def import_volume(path: Path, labels: Path, out: Path, spacing_mm: float | None = None) -> dict[str, Any]:
    """Make the folder ``out`` from a volume file and its label map; returns the record of origin.

    With ``spacing_mm`` the labels are resampled to cubes of that size. Cruciate ligaments that were not segmented are
    swept between the bones. Raises ConfigError when file, map or anatomy are not in order; ``out`` is then not made.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ConfigError(f"{out}: is there already; give --out a folder that is empty or new")
    file = volume_file.read(path)
    given = label_map.read(labels)
    found = inspection.regions(file)
    inspection.check(file, found, given)
    volume = sorted_axes(file, given.renumber())
    if spacing_mm is not None:
        _check_spacing(volume, spacing_mm)
        volume = resample(volume, (spacing_mm, spacing_mm, spacing_mm))
    side = inspection.side(found, given) or given.side
    volume, swept, not_swept = swept_cruciates(volume, side)
    record: dict[str, Any] = {
        "program_version": __version__,
        "source": {
            "path": str(path.resolve()),
            "sha256": file.sha256,
            "shape": list(file.values.shape),
            "spacing_mm": file.spacing_mm.tolist(),
            "orientation": file.orientation,
            "lps_from_index": file.lps_from_index.tolist(),
        },
        "label_map": {"path": str(labels), "labels": {str(k): v for k, v in given.labels.items()}},
        "side": side,
        "shape": list(volume.labels.shape),
        "spacing_mm": list(volume.spacing_mm),
        "swept": swept,
        "not_swept": not_swept,
    }
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.name}-") as folder:
        made = Path(folder) / "made"
        made.mkdir()
        record["structures"] = _write(volume, made)
        present = {row["structure"] for row in record["structures"]}
        record["missing"] = [name for name in structures() if name not in present]
        (made / RECORD).write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
        if out.exists():
            out.rmdir()
        shutil.move(made, out)
    return record


def load(folder: Path) -> Anatomy:
    """The knee in a folder that ``import_volume`` made. Raises ConfigError."""
    record = read_record(folder)
    volume = sorted_axes(volume_file.read(folder / LABELS), np.arange(volume_file.LARGEST_LABEL + 1).astype(np.uint8))
    return Anatomy(folder.name, volume, str(record.get("side", "")), str(folder.resolve()))


def read_record(folder: Path) -> dict[str, Any]:
    """The record of origin in an imported folder. Raises ConfigError."""
    path = folder / RECORD
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigError(
            f"{folder}: no imported anatomy: it has no {RECORD}; make one with `anatomy import`"
        ) from None
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from None
    if not isinstance(record, dict):
        raise ConfigError(f"{path}: expected an object, found {type(record).__name__}")
    return record


def _write(volume: LabelVolume, folder: Path) -> list[dict[str, Any]]:
    """Labels and surfaces of all structures; returns what each one is like."""
    import trimesh

    write_nrrd(volume, folder / LABELS)
    (folder / SURFACES).mkdir()
    volumes = volume.volumes_ml()
    rows = []
    for name, structure in structures().items():
        if structure.number in volumes:
            surface = surfaces.surface_of(volume, structure.number)
            file = f"{SURFACES}/{name.replace(' ', '-')}.ply"
            mesh = trimesh.Trimesh(surface.points, surface.triangles, process=False)
            (folder / file).write_bytes(trimesh.exchange.ply.export_ply(mesh))
            rows.append(
                {
                    "structure": name,
                    "number": structure.number,
                    "volume_ml": volumes[structure.number],
                    "surface": file,
                    "surface_volume_ml": surface.volume_ml(),
                    "triangles": len(surface.triangles),
                }
            )
    return rows


def _check_spacing(volume: LabelVolume, spacing_mm: float) -> None:
    box = np.array(volume.labels.shape) * volume.spacing_mm
    if not 0.05 <= spacing_mm <= box.min() or float(np.prod(box / spacing_mm)) > volume_file.MOST_VOXELS:
        raise ConfigError(
            f"--spacing-mm {spacing_mm:g}: expected 0.05 to {box.min():g} mm, "
            f"and at most {volume_file.MOST_VOXELS} voxels"
        )
