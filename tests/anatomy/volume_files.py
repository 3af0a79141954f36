"""Writers of small label volumes in every format, for tests: independent of the program's readers."""

from __future__ import annotations

import gzip
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from trainer.geometry import Array


def write_nrrd(path: Path, values: np.ndarray, affine: Array, space: str = "left-posterior-superior") -> None:
    """By hand: text header, then gzip; ``affine`` (4, 4) in the named space."""
    kinds = {"uint8": "uchar", "int8": "int8", "int16": "short", "uint16": "ushort", "float32": "float", "int32": "int"}
    directions = " ".join("(" + ",".join(repr(float(v)) for v in column) + ")" for column in affine[:3, :3].T)
    directions += " none" * (values.ndim - 3)
    header = (
        f"NRRD0004\ntype: {kinds[values.dtype.name]}\ndimension: {values.ndim}\nspace: {space}\n"
        f"sizes: {' '.join(map(str, values.shape))}\nspace directions: {directions}\nendian: little\n"
        f"encoding: gzip\nspace origin: ({','.join(repr(float(v)) for v in affine[:3, 3])})\n\n"
    )
    path.write_bytes(header.encode() + gzip.compress(values.tobytes(order="F")))


def write_nifti(path: Path, values: np.ndarray, affine: Array, code: int = 1) -> None:
    """By hand: the 348 bytes of a NIfTI-1 header with an sform; ``affine`` (4, 4) LPS becomes RAS."""
    kinds = {"uint8": 2, "int16": 4, "int32": 8, "float32": 16, "int8": 256, "uint16": 512}
    ras = np.diag([-1.0, -1.0, 1.0, 1.0]) @ affine
    dim = [values.ndim, *values.shape, *[1] * (7 - values.ndim)]
    spacing = [1.0, *np.linalg.norm(affine[:3, :3], axis=0), *[1.0] * 4]
    header = struct.pack("<i35xb", 348, 0)
    header += struct.pack("<8h", *dim) + struct.pack("<3f", 0, 0, 0)
    header += struct.pack("<4h", 0, kinds[values.dtype.name], 8 * values.dtype.itemsize, 0) + struct.pack(
        "<8f", *spacing
    )
    header += struct.pack("<3fhbb4f2i", 352.0, 1.0, 0.0, 0, 0, 2, 0, 0, 0, 0, 0, 0)
    header += b"\0" * 104 + struct.pack("<2h", 0, code) + struct.pack("<6f", *[0.0] * 6)
    header += struct.pack("<12f", *ras[:3].ravel()) + b"\0" * 16 + b"n+1\0"
    assert len(header) == 348
    data = header + b"\0" * 4 + values.tobytes(order="F")
    path.write_bytes(gzip.compress(data) if path.suffix == ".gz" else data)


def write_mha(
    path: Path, values: np.ndarray, affine: Array, compressed: bool = False, big_endian: bool = False
) -> None:
    """By hand: MetaImage, elements in the file or, for ``.mhd``, beside it."""
    kinds = {"uint8": "UCHAR", "int8": "CHAR", "int16": "SHORT", "uint16": "USHORT", "float32": "FLOAT", "int32": "INT"}
    spacing = np.linalg.norm(affine[:3, :3], axis=0)
    words = {
        "ObjectType": "Image",
        "NDims": values.ndim,
        "BinaryDataByteOrderMSB": big_endian,
        "CompressedData": compressed,
        "TransformMatrix": " ".join(repr(float(v)) for v in (affine[:3, :3] / spacing).T.ravel()),
        "Offset": " ".join(repr(float(v)) for v in affine[:3, 3]),
        "ElementSpacing": " ".join(repr(float(v)) for v in spacing),
        "DimSize": " ".join(map(str, values.shape)),
        "ElementType": f"MET_{kinds[values.dtype.name]}",
        "ElementDataFile": "LOCAL" if path.suffix == ".mha" else path.with_suffix(".raw").name,
    }
    data = values.astype(values.dtype.newbyteorder(">" if big_endian else "<")).tobytes(order="F")
    data = zlib.compress(data) if compressed else data
    header = "".join(f"{key} = {value}\n" for key, value in words.items()).encode()
    path.write_bytes(header + (data if path.suffix == ".mha" else b""))
    if path.suffix == ".mhd":
        path.with_suffix(".raw").write_bytes(data)


def write_nrrd_ras(path: Path, values: np.ndarray, affine: Array) -> None:
    write_nrrd(path, values, np.diag([-1.0, -1.0, 1.0, 1.0]) @ affine, "right-anterior-superior")


def write_packed_mha(path: Path, values: np.ndarray, affine: Array) -> None:
    write_mha(path, values, affine, compressed=True, big_endian=True)


#: File name and writer of each format.
FORMATS: dict[str, Callable[[Path, np.ndarray, Array], None]] = {
    "a.nrrd": write_nrrd,
    "ras.nrrd": write_nrrd_ras,
    "a.nii": write_nifti,
    "a.nii.gz": write_nifti,
    "a.mha": write_mha,
    "packed.mha": write_packed_mha,
    "a.mhd": write_mha,
}
