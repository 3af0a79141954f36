"""Segmented volumes from files: NRRD, NIfTI and MetaImage, each with its own axes, into one description.

Whatever a file says about its axes ends up as ``lps_from_index``: where the centre of voxel (i, j, k) lies in the
patient, mm to the left, to the back and up (LPS, the convention of DICOM, ITK and 3D Slicer's files). NIfTI counts to
the right, to the front and up (RAS); NRRD says which it means.
"""

from __future__ import annotations

import hashlib
import warnings
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from trainer import image_header
from trainer.config import ConfigError
from trainer.geometry import Array

#: For each of NRRD's named spaces the signs that lead from its axes to L, P and S.
NRRD_SPACES = {
    "left-posterior-superior": (1, 1, 1),
    "lps": (1, 1, 1),
    "right-anterior-superior": (-1, -1, 1),
    "ras": (-1, -1, 1),
    "left-anterior-superior": (1, -1, 1),
    "las": (1, -1, 1),
}
RAS = (-1, -1, 1)
NIFTI_MM = 2

#: Cosine of the angle between two axes that still counts as square: NIfTI keeps its axes in single precision, texts
#: keep six digits, and neither moves the far corner of 1000 voxels by more than one of them.
SQUARE = 1e-3
MOST_VOXELS = 2**31  # assumed: 1290³, more than any scanner's volume of a knee
LARGEST_LABEL = 65535


@dataclass(frozen=True)
class FileVolume:
    """A file's labels as they are stored, and where they lie."""

    path: str
    values: np.ndarray  # (nx, ny, nz) unsigned integers, axes in the file's order
    lps_from_index: Array  # (4, 4) mm, LPS
    sha256: str  # of the file, and of the elements' file where they are apart

    @property
    def spacing_mm(self) -> Array:
        """Distance of two voxels along each axis, (3,)."""
        return np.asarray(np.linalg.norm(self.lps_from_index[:3, :3], axis=0))

    @property
    def orientation(self) -> str:
        """Towards which side of the patient each axis runs most: three of L, R, P, A, S, I."""
        return "".join(
            ("LPS" if column[k] > 0.0 else "RAI")[k]
            for column in self.lps_from_index[:3, :3].T
            for k in [int(np.argmax(np.abs(column)))]
        )


def read(path: str | Path) -> FileVolume:
    """The label volume in a ``.nrrd``, ``.nhdr``, ``.nii``, ``.nii.gz``, ``.mha`` or ``.mhd`` file.

    Raises ConfigError, one line, for a file that is missing, truncated or damaged, has not three dimensions, axes that
    are not finite, not square or not known, or elements that are no labels (whole numbers from 0 to 65535).
    """
    file = Path(path)
    readers = {".nrrd": _nrrd, ".nhdr": _nrrd, ".nii": _nifti, ".gz": _nifti, ".mha": _mha, ".mhd": _mha}
    reader = readers.get(file.suffix.lower())
    if reader is None or (file.suffix.lower() == ".gz" and not file.name.lower().endswith(".nii.gz")):
        raise ConfigError(f"{file}: not a volume that is known by its ending; expected .nrrd, .nii, .nii.gz or .mha")
    if not file.is_file():
        raise ConfigError(f"{file}: no such file")
    values, affine, elements = reader(file)
    _check_axes(affine, file)
    digest = hashlib.sha256(file.read_bytes())
    if elements != file:
        digest.update(elements.read_bytes())
    return FileVolume(str(file), _labels(_three_dimensional(values, file), file), affine, digest.hexdigest())


def _nrrd(file: Path) -> tuple[np.ndarray, Array, Path]:
    import nrrd

    try:
        values, header = nrrd.read(str(file))
    except Exception as error:  # a damaged file makes that reader raise whatever its bytes lead to
        raise _unreadable(file, error) from None
    if values.ndim != 3:
        raise _not_three(file, values.shape)
    space = str(header.get("space", "")).lower()
    if space not in NRRD_SPACES:
        raise ConfigError(
            f"{file}: 'space' must be left-posterior-superior, right-anterior-superior or left-anterior-superior, "
            f"found '{space}': which way the patient lies is not known"
        )
    units = {str(u).strip('"').lower() for u in header.get("space units", [])}
    if units - {"mm", ""}:
        raise ConfigError(f"{file}: 'space units' must be mm, found {', '.join(sorted(units))}")
    directions = np.asarray(header.get("space directions", np.full((3, 3), np.nan)), dtype=np.float64)
    origin = np.asarray(header.get("space origin", np.zeros(3)), dtype=np.float64)
    if directions.shape != (3, 3) or origin.shape != (3,):
        raise ConfigError(f"{file}: 'space directions' and 'space origin' must have three numbers for each axis")
    elements = file.parent / str(header.get("data file", file.name))
    return values, _affine(directions.T, origin, NRRD_SPACES[space]), elements


def _nifti(file: Path) -> tuple[np.ndarray, Array, Path]:
    import nibabel

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # a NaN in the header is told below, as an error
            image = nibabel.load(file)
            if not isinstance(image, nibabel.Nifti1Pair):
                raise ConfigError(f"{file}: not a NIfTI file")
            header = image.header
            values = np.asanyarray(image.dataobj)
            known = bool(header["sform_code"]) or bool(header["qform_code"])
            spacing = np.asarray(header["pixdim"][1:4], dtype=np.float64)
            affine = np.asarray(image.affine, dtype=np.float64)
            unit = int(header["xyzt_units"]) & 7
    except ConfigError:
        raise
    except Exception as error:  # as above
        raise _unreadable(file, error) from None
    if not known:
        raise ConfigError(
            f"{file}: neither 'sform_code' nor 'qform_code' is set: which way the patient lies is not known"
        )
    if not np.isfinite(spacing).all():
        raise ConfigError(f"{file}: spacing {_list(spacing)} is not finite")
    if unit not in (NIFTI_MM, 0):
        raise ConfigError(f"{file}: 'xyzt_units' must be mm, code {NIFTI_MM}, found code {unit}")
    return values, _affine(affine[:3, :3], affine[:3, 3], RAS), file


def _mha(file: Path) -> tuple[np.ndarray, Array, Path]:
    header, begins = image_header.read_meta_image(file)
    sizes = image_header.sizes(header, "DimSize", str(file))
    if len(sizes) != 3:
        raise _not_three(file, tuple(sizes))
    if int(np.prod([float(s) for s in sizes])) > MOST_VOXELS:
        raise ConfigError(f"{file}: 'DimSize' {sizes} is more than {MOST_VOXELS} voxels")
    spacing = _numbers(header, ("ElementSpacing", "ElementSize"), [1.0] * 3, file)
    origin = _numbers(header, ("Offset", "Position", "Origin"), [0.0] * 3, file)
    axes = _numbers(header, ("TransformMatrix", "Rotation", "Orientation"), np.eye(3).ravel().tolist(), file)
    kind, channels = image_header.element_type(header, str(file))
    if channels != 1:
        raise ConfigError(f"{file}: {channels} channels; expected one label for each voxel")
    local = header["ElementDataFile"].upper() == "LOCAL"
    elements = file if local else file.parent / header["ElementDataFile"]
    try:
        data = elements.read_bytes()[begins if local else 0 :]
        if header.get("CompressedData", "False").lower() == "true":
            data = zlib.decompress(data)
    except (OSError, zlib.error) as error:
        raise _unreadable(elements, error) from None
    swapped = {header.get(k, "False").lower() for k in ("BinaryDataByteOrderMSB", "ElementByteOrderMSB")}
    order = ">" if "true" in swapped else "<"
    count = int(np.prod(sizes, dtype=np.int64))
    image_header.check_length(len(data), count * int(kind[1]), str(file))
    values = np.frombuffer(data, np.dtype(f"{order}{kind}"), count).reshape(sizes, order="F")
    return values, _affine(axes.reshape(3, 3).T * spacing, origin, (1, 1, 1)), elements


def _numbers(header: dict[str, str], keys: tuple[str, ...], default: list[float], file: Path) -> Array:
    """The numbers at the first of ``keys`` that the header has."""
    key = next((k for k in keys if k in header), None)
    if key is None:
        return np.array(default)
    try:
        found = [float(n) for n in header[key].split()]
    except ValueError:
        found = []
    if len(found) != len(default):
        raise ConfigError(f"{file}: '{key}' expected {len(default)} numbers, found '{header[key][:40]}'")
    return np.array(found)


def _affine(axes: Array, origin: Array, to_lps: tuple[int, int, int]) -> Array:
    """(4, 4) from axes (3, 3), a column each, and origin (3,), both in a space that ``to_lps`` leads to LPS."""
    affine = np.eye(4)
    affine[:3, :3] = axes * np.array(to_lps)[:, None]
    affine[:3, 3] = origin * to_lps
    return affine


def _check_axes(affine: Array, file: Path) -> None:
    spacing = np.linalg.norm(affine[:3, :3], axis=0)
    if not np.isfinite(affine).all():
        raise ConfigError(f"{file}: spacing {_list(spacing)} or origin {_list(affine[:3, 3])} is not finite")
    if spacing.min() <= 1e-6 or spacing.max() > 1e3:
        raise ConfigError(f"{file}: spacing {_list(spacing)} mm; expected more than 0 and at most 1000 along each axis")
    cosines = (affine[:3, :3] / spacing).T @ (affine[:3, :3] / spacing) - np.eye(3)
    if np.abs(cosines).max() > SQUARE:
        raise ConfigError(
            f"{file}: the axes are not at right angles (cosine {np.abs(cosines).max():.3g}); resample it before"
        )


def _three_dimensional(values: np.ndarray, file: Path) -> np.ndarray:
    """The array without the axes of length 1 that follow the third."""
    while values.ndim > 3 and values.shape[-1] == 1:
        values = values[..., 0]
    if values.ndim != 3 or values.size == 0:
        raise _not_three(file, values.shape)
    return values


def _labels(values: np.ndarray, file: Path) -> np.ndarray:
    """Elements as unsigned integers of one or two bytes."""
    if values.dtype.kind not in "iuf":
        raise ConfigError(f"{file}: elements of type {values.dtype} are no labels; expected whole numbers")
    low, high = float(values.min()), float(values.max())
    if not (np.isfinite(low) and np.isfinite(high)):
        raise ConfigError(f"{file}: some elements are not finite; expected labels, whole numbers from 0")
    if low < 0.0 or high > LARGEST_LABEL:
        raise ConfigError(f"{file}: elements from {low:g} to {high:g}; expected labels from 0 to {LARGEST_LABEL}")
    out = values.astype(np.uint8 if high < 256.0 else np.uint16)
    if values.dtype.kind == "f" and not np.array_equal(out, values):
        odd = float(values[out != values].flat[0])
        raise ConfigError(f"{file}: an element of {odd:g} is no label; expected whole numbers (is it a picture?)")
    return out


def _unreadable(file: Path, error: Exception) -> ConfigError:
    if isinstance(error, FileNotFoundError):  # of the elements: the header is there
        return ConfigError(f"{error.filename or file}: no such file, where a header says that its elements are")
    if file.stat().st_size == 0:
        return ConfigError(f"{file}: an empty file; copy it again")
    reason = " ".join(str(error).split())[:160] or type(error).__name__
    return ConfigError(f"{file}: cut short or damaged ({reason}); copy the file again")


def _not_three(file: Path, shape: tuple[int, ...]) -> ConfigError:
    sizes = " × ".join(str(n) for n in shape)
    return ConfigError(f"{file}: {len(shape)} dimensions ({sizes}); expected one volume of three")


def _list(values: Array) -> str:
    return " × ".join(f"{v:g}" for v in values)
