"""Label volumes from files: the same places in the patient from every format, and one line for each bad file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from volume_files import FORMATS, write_mha, write_nifti, write_nrrd

from trainer.anatomy.label_volume import LabelVolume, resample, sorted_axes
from trainer.anatomy.label_volume import write_nrrd as write_ours
from trainer.anatomy.volume_file import FileVolume, read
from trainer.config import ConfigError
from trainer.geometry import Array, Rigid, matrix_from_quaternion, quaternion_from_axis_angle

RANDOM = np.random.default_rng(3)
VALUES = RANDOM.integers(0, 5, (5, 4, 3)).astype(np.uint8)
SAME = np.arange(65536).astype(np.uint8)


def oblique(
    angle: float = 0.4, signs: tuple[int, int, int] = (1, -1, 1), order: tuple[int, int, int] = (2, 0, 1)
) -> Array:
    """Axes exchanged, mirrored and turned about a skew line; voxels of 0.4 × 0.5 × 1.3 mm."""
    affine = np.eye(4)
    axes = np.eye(3)[:, list(order)] * signs
    turn = matrix_from_quaternion(quaternion_from_axis_angle([1.0, 2.0, -1.5], angle))
    affine[:3, :3] = turn @ axes * [0.4, 0.5, 1.3]
    affine[:3, 3] = -30.0, 12.5, 71.0
    return affine


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("kind", ["uint8", "int8", "int16", "uint16", "float32"])
def test_every_format_puts_labels_in_the_same_place(name: str, kind: str, tmp_path: Path) -> None:
    """Oblique, anisotropic, mirrored axes: values as written, the matrix to what the format stores.

    NIfTI keeps its matrix in single precision: 1e-6 of 71 mm. The others print all digits.
    """
    path = tmp_path / name
    FORMATS[name](path, VALUES.astype(kind), oblique())
    file = read(path)
    np.testing.assert_array_equal(file.values, VALUES)
    assert file.values.dtype == np.uint8
    np.testing.assert_allclose(file.lps_from_index, oblique(), atol=1e-5 if ".nii" in name else 1e-12)
    np.testing.assert_allclose(file.spacing_mm, [0.4, 0.5, 1.3], rtol=1e-6)
    assert len(file.sha256) == 64


def test_orientation_names_the_sides_towards_which_axes_run(tmp_path: Path) -> None:
    """Identity in LPS runs to L, P, S; NIfTI's identity to R, A, S."""
    write_nrrd(tmp_path / "a.nrrd", VALUES, np.eye(4))
    write_nrrd(tmp_path / "b.nrrd", VALUES, np.eye(4), "RAS")
    write_nrrd(tmp_path / "c.nrrd", VALUES, oblique(0.0))
    assert read(tmp_path / "a.nrrd").orientation == "LPS"
    assert read(tmp_path / "b.nrrd").orientation == "RAS"
    assert read(tmp_path / "c.nrrd").orientation == "SRP"


def places(volume: LabelVolume) -> dict[int, Array]:
    return {k: np.array(sorted(map(tuple, np.round(volume.points_mm(k), 6).tolist()))) for k in volume.volumes_ml()}


@given(
    st.floats(-3.1, 3.1),
    st.tuples(*[st.sampled_from([-1, 1])] * 3),
    st.permutations([0, 1, 2]),
)
def test_sorting_axes_moves_no_label(angle: float, signs: tuple[int, int, int], order: list[int]) -> None:
    """Each label's voxels lie where the file's matrix puts them; axes are right-handed and next to L, P, S.

    Products of numbers below 100 at 1e-16, and a polar decomposition of orthogonal axes: 1e-9 is generous.
    """
    file = FileVolume("x", VALUES, oblique(angle, signs, (order[0], order[1], order[2])), "")
    volume = sorted_axes(file, SAME)
    matrix = volume.lps_from_volume.matrix
    assert np.linalg.det(matrix) == pytest.approx(1.0)
    assert volume.labels.flags.c_contiguous
    assert volume.labels.dtype == np.uint8
    for label, found in places(volume).items():
        index = np.argwhere(label == VALUES)
        wanted = index @ file.lps_from_index[:3, :3].T + file.lps_from_index[:3, 3]
        distance = np.linalg.norm(found[:, None] - wanted[None], axis=2)
        assert distance.min(axis=1).max() < 1e-5
        assert distance.min(axis=0).max() < 1e-5


def test_what_is_written_lies_where_it_was(tmp_path: Path) -> None:
    """Ours out and in again; pynrrd prints the matrix with all digits."""
    volume = sorted_axes(FileVolume("x", VALUES, oblique(), ""), SAME)
    write_ours(volume, tmp_path / "ours.nrrd")
    again = sorted_axes(read(tmp_path / "ours.nrrd"), SAME)
    np.testing.assert_array_equal(again.labels, volume.labels)
    np.testing.assert_allclose(again.spacing_mm, volume.spacing_mm, rtol=1e-12)
    np.testing.assert_allclose(again.lps_from_volume.position, volume.lps_from_volume.position, atol=1e-9)
    np.testing.assert_allclose(again.lps_from_volume.matrix, volume.lps_from_volume.matrix, atol=1e-9)


@settings(max_examples=30)
@given(st.floats(0.2, 0.9))
def test_resampling_keeps_labels_in_place(spacing: float) -> None:
    """Each new voxel has the label of the old voxel in which its centre lies, and the grids cover the same box.

    A centre may lie on an old voxel's face: 1e-6 of a voxel beside it is not looked at, nor a spacing where that
    leaves less than a fifth of all (of 0.8 mm, twice the old, none). The number of new voxels is rounded, so the box
    differs by half a new voxel at most.
    """
    at = np.indices((24, 24, 24)) * 0.4
    labels = ((at - 4.6) ** 2).sum(axis=0) < 4.0**2
    place = Rigid(np.array([1.0, 2.0, 3.0]), quaternion_from_axis_angle([1.0, 0.5, 2.0], 0.7))
    ball = LabelVolume(labels.astype(np.uint8), (0.4, 0.4, 0.4), place)
    other = resample(ball, (spacing, spacing, spacing))
    index = np.indices(other.labels.shape).reshape(3, -1).T
    old = place.inverse().apply(other.lps_from_volume.apply(index * spacing)) / 0.4
    nearest = np.clip(np.round(old), 0, 23).astype(int)
    clear = np.all(np.abs(np.abs(old - nearest) - 0.5) > 1e-6, axis=1)
    assume(clear.mean() > 0.2)
    np.testing.assert_array_equal(other.labels.ravel()[clear], ball.labels[tuple(nearest[clear].T)])
    np.testing.assert_allclose(np.array(other.labels.shape) * spacing, 24 * 0.4, atol=0.5 * spacing + 1e-9)


def test_resampling_to_the_same_grid_changes_nothing() -> None:
    volume = sorted_axes(FileVolume("x", VALUES, oblique(), ""), SAME)
    same = resample(volume, volume.spacing_mm)
    np.testing.assert_array_equal(same.labels, volume.labels)
    np.testing.assert_array_equal(same.lps_from_volume.position, volume.lps_from_volume.position)


def bad(kind: str, folder: Path) -> Path:
    """A file with one thing wrong."""
    nan, skew = oblique(), oblique()
    nan[:3, :3] *= np.nan
    skew[:3, 0] += 0.2 * skew[:3, 1]
    values = VALUES.astype(np.float32)
    values[1, 1, 1] = 0.5
    path = folder / f"{kind}.nrrd"
    if kind == "half a label":
        write_nrrd(path, values, oblique())
    elif kind == "not finite":
        values[1, 1, 1] = np.nan
        write_nrrd(path, values, oblique())
    elif kind == "negative":
        write_nrrd(path, VALUES.astype(np.int16) - 1, oblique())
    elif kind == "nan spacing":
        write_nrrd(path, VALUES, nan)
    elif kind == "skew":
        write_nrrd(path, VALUES, skew)
    elif kind == "no space":
        write_nrrd(path, VALUES, oblique())
        path.write_bytes(path.read_bytes().replace(b"space: left-posterior-superior\n", b"space dimension: 3\n"))
    elif kind == "4-d":
        write_nrrd(path, np.stack([VALUES, VALUES], axis=3), oblique())
    elif kind == "truncated":
        write_nrrd(path, VALUES, oblique())
        path.write_bytes(path.read_bytes()[:-20])
    elif kind == "nothing":
        path.write_bytes(b"")
    elif kind.startswith("nifti"):
        path = folder / f"{kind.replace(' ', '-')}.nii"
        write_nifti(
            path, np.stack([VALUES] * 2, axis=3) if "4-d" in kind else VALUES, oblique(), 0 if "code" in kind else 1
        )
        if "truncated" in kind:
            path.write_bytes(path.read_bytes()[:-20])
        if "nan" in kind:
            data = bytearray(path.read_bytes())
            data[80:84] = np.float32(np.nan).tobytes()
            path.write_bytes(data)
    elif kind.startswith("mha"):
        path = folder / f"{kind.replace(' ', '-')}.mha"
        write_mha(path, VALUES, nan if "nan" in kind else oblique(), compressed="packed" in kind)
        if "truncated" in kind:
            path.write_bytes(path.read_bytes()[:-20])
        if "4-d" in kind:
            path.write_bytes(path.read_bytes().replace(b"DimSize = 5 4 3", b"DimSize = 5 4 3 1"))
    else:
        path = folder / kind
        path.write_bytes(b"x") if kind != "missing.nrrd" else None
    return path


BAD = {
    "half a label": "an element of 0.5 is no label",
    "not finite": "some elements are not finite",
    "negative": "elements from -1 to 3; expected labels from 0",
    "nan spacing": r"spacing nan × nan × nan .*is not finite",
    "skew": "the axes are not at right angles",
    "no space": "'space' must be left-posterior-superior, .*which way the patient lies is not known",
    "4-d": r"4 dimensions \(5 × 4 × 3 × 2\); expected one volume of three",
    "truncated": "cut short or damaged",
    "nothing": "an empty file; copy it again",
    "nifti truncated": "cut short or damaged",
    "nifti 4-d": "4 dimensions",
    "nifti without code": "neither 'sform_code' nor 'qform_code' is set",
    "nifti nan": "spacing nan × .* is not finite",
    "mha truncated": "the pictures are cut short: 40 of 60 bytes",
    "mha packed truncated": "cut short or damaged",
    "mha nan": "is not finite",
    "mha 4-d": "4 dimensions",
    "missing.nrrd": "no such file",
    "a.dcm": "not a volume that is known by its ending",
    "a.gz": "not a volume that is known by its ending",
}


@pytest.mark.parametrize("kind", BAD)
def test_a_bad_file_is_one_line(kind: str, tmp_path: Path) -> None:
    path = bad(kind, tmp_path)
    with pytest.raises(ConfigError, match=BAD[kind]) as caught:
        read(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("name", FORMATS)
def test_a_file_cut_anywhere_is_one_line(name: str, tmp_path: Path) -> None:
    """However much is missing: an error of ours, never another, never labels out of nothing."""
    path = tmp_path / name
    FORMATS[name](path, VALUES, oblique())
    data = path.read_bytes()
    # The last bytes of gzip are a checksum and a length; all elements may be there without them.
    for size in range(0, len(data) - (9 if "gz" in name or "nrrd" in name else 1), 7):
        path.write_bytes(data[:size])
        with pytest.raises(ConfigError, match="a") as caught:
            read(path)
        assert str(tmp_path) in str(caught.value)


@pytest.mark.parametrize("kind", ["nhdr", "mhd"])
def test_elements_that_are_apart_and_not_there_are_named(kind: str, tmp_path: Path) -> None:
    """Such a header is not damaged, and copying it again would not help."""
    path = tmp_path / f"scan.{kind}"
    if kind == "mhd":
        write_mha(path, VALUES, oblique())
    else:
        write_nrrd(path, VALUES, oblique())
        header, _, data = path.read_bytes().partition(b"\n\n")
        path.write_bytes(header + b"\ndata file: scan.raw\n\n")
        (tmp_path / "scan.raw").write_bytes(data)
    np.testing.assert_array_equal(read(path).values, VALUES)
    (tmp_path / "scan.raw").unlink()
    with pytest.raises(ConfigError, match=r"scan\.raw: no such file, where a header says that its elements are"):
        read(path)
