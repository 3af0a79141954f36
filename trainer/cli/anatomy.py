"""``trainer anatomy``: which knees there are, what a segmented scan holds, and making one from it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

app = typer.Typer(help="Knees: built-in, inspected, imported.", no_args_is_help=True)

JsonOption = Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")]
PathArgument = Annotated[Path, typer.Argument(metavar="PATH", help="A label volume: .nrrd, .nii, .nii.gz or .mha.")]


@app.command("list")
def list_(as_json: JsonOption = False) -> None:
    """List the built-in knees, the shipped label maps and the structures that a knee may have."""
    from trainer.anatomy import knee, label_map
    from trainer.anatomy.structures import structures

    knees = knee.names()
    maps = {Path(m.path).stem: sorted(m.labels.values()) for m in label_map.shipped()}
    kinds = {name: structure.kind for name, structure in structures().items()}
    if as_json:
        print(json.dumps({"built_in": knees, "label_maps": maps, "structures": kinds}, indent=2))
        return
    for name in knees:
        print(f"{name:<28} built-in knee")
    for name in maps:
        print(f"{name:<28} label map")
    for name, kind in kinds.items():
        print(f"{name:<28} {kind}")


@app.command()
def inspect(
    path: PathArgument,
    labels: Annotated[
        Path | None,
        typer.Option(
            metavar="TOML", help="Which label is which structure, a file or a shipped map; otherwise recognised."
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Say what a label volume holds: axes, side, volumes, what is missing; exit code 1 when something is wrong."""
    from trainer.anatomy import inspection, label_map, volume_file

    given = label_map.read(labels) if labels is not None else None
    found = inspection.describe(volume_file.read(path), given)
    if as_json:
        print(json.dumps(found, indent=2, allow_nan=False))
    else:
        _print_inspection(found)
    for problem in found["problems"]:
        typer.echo(problem, err=True)
    if found["problems"]:
        raise typer.Exit(1)


@app.command("import")
def import_(
    path: PathArgument,
    labels: Annotated[
        Path, typer.Option(metavar="TOML", help="Which label is which structure: a file, or a shipped map's name.")
    ],
    out: Annotated[Path, typer.Option(metavar="DIR", help="A new folder for the knee.")],
    spacing_mm: Annotated[
        float | None, typer.Option(metavar="MM", help="Resample to cubes of this size; otherwise as the scan is.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Make a knee for scenes from a label volume: sorted labels, closed surfaces, a record of their origin."""
    from trainer.anatomy.imported import import_volume

    record = import_volume(path, labels, out, spacing_mm)
    if as_json:
        print(json.dumps(record, indent=2, allow_nan=False))
        return
    print(f"{out}: a {record['side'] or 'knee of unknown side'} knee, {_sizes(record['shape'])} voxels of "
          f"{_sizes(record['spacing_mm'])} mm")  # fmt: skip
    for row in record["structures"]:
        off = 100.0 * (row["surface_volume_ml"] / row["volume_ml"] - 1.0)
        print(
            f"{row['structure']:<28} {row['volume_ml']:8.2f} mL   surface {row['triangles']:6d} triangles, {off:+.2f} %"
        )
    for name, how in record["swept"].items():
        print(f"swept: {name}, {how['volume_ml']:.2f} mL, {how['length_mm']:.1f} mm")
    for name, why in record["not_swept"].items():
        print(f"not swept: {name}: {why}")
    print(f"missing: {', '.join(record['missing']) or 'nothing'}")


def _print_inspection(found: dict[str, Any]) -> None:
    print(f"voxels       {_sizes(found['shape'])} of {_sizes(found['spacing_mm'])} mm")
    print(f"orientation  {found['orientation']} (the sides of the patient towards which the axes run)")
    print(f"side         {found['side'] or 'not known'}")
    if found["label_map"]:
        print(f"label map    {found['label_map']}{' (recognised)' if found['label_map_recognised'] else ''}")
    for row in found["labels"]:
        print(f"{row['label']:5d}  {row['structure'] or '?':<28} {row['volume_ml']:8.2f} mL")
    print(f"missing      {', '.join(found['missing']) or 'nothing'}")


def _sizes(values: list[float]) -> str:
    return " × ".join(f"{v:.4g}" for v in values)
