"""Knees from label volumes: maps, landmarks, surfaces, import; the built-in knee; ligaments; the real knee."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from volume_files import write_nrrd

from trainer.anatomy import imported, inspection, knee, label_map, library, ligaments, surfaces, volume_file
from trainer.anatomy.label_volume import LabelVolume, resample
from trainer.anatomy.label_volume import write_nrrd as write_ours
from trainer.anatomy.structures import number_of, structures
from trainer.config import ConfigError
from trainer.geometry import Array, Rigid

SHARED = Path(__file__).parents[3] / "shared/data/knee"
REAL = SHARED / "SAG_3D_DESS_RIGHT_bones_cart_men_fib-label.nrrd"
ROOT = Path(__file__).parents[2]
MSKT = ROOT / "trainer/anatomy/data/labels/mskt.toml"
real_knee = pytest.mark.skipif(not REAL.exists(), reason="the segmented knee of shared/data is not here")

#: mL, from the table in shared/data/README.md, which gives one decimal.
PUBLISHED = {
    "femoral cartilage": 11.8, "medial tibial cartilage": 1.9, "lateral tibial cartilage": 1.8,
    "patellar cartilage": 1.2, "femur": 142.6, "tibia": 101.4, "patella": 13.4, "fibula": 10.4,
    "lateral meniscus": 2.1, "medial meniscus": 2.3,
}  # fmt: skip


@pytest.fixture(scope="module")
def built() -> LabelVolume:
    return knee.build(knee.load("knee"), 1.0)


@pytest.fixture
def scan(built: LabelVolume, tmp_path: Path) -> Path:
    """The built-in knee as somebody's scan, with its ligaments left out and its labels shifted by 20."""
    labels = built.labels.copy()
    labels[labels > 10] = 0
    labels[labels > 0] += 20
    path = tmp_path / "scan.nrrd"
    write_ours(LabelVolume(labels, built.spacing_mm, built.lps_from_volume), path)
    return path


def write_map(folder: Path, changes: dict[str, str] | None = None, side: str = "") -> Path:
    lines = {str(s.number + 20): name for name, s in structures().items() if s.number <= 10} | (changes or {})
    path = folder / "labels.toml"
    head = f'side = "{side}"\n' if side else ""
    path.write_text(head + "[labels]\n" + "".join(f'{k} = "{v}"\n' for k, v in lines.items() if v))
    return path


def test_the_built_in_knee_has_every_structure_in_one_piece(built: LabelVolume) -> None:
    from scipy.ndimage import label

    for name, structure in structures().items():
        assert label(built.labels == structure.number, np.ones((3, 3, 3)))[1] == 1, name


def test_the_built_in_knee_is_about_as_large_as_the_measured_one(built: LabelVolume) -> None:
    """Its numbers are measured ones, its shapes simple: within 45 % of the real structures' volumes (assumed)."""
    volumes = built.volumes_ml()
    for name, ml in PUBLISHED.items():
        assert volumes[number_of(name)] == pytest.approx(ml, rel=0.45), name


@pytest.mark.parametrize("voxel_mm", [0.8, 1.5])
def test_the_built_in_knee_is_the_same_at_any_resolution(voxel_mm: float, built: LabelVolume) -> None:
    """Bones are solid: a voxel at the surface is in or out by half of it, at random; 2 % is far above that.

    Cartilage and menisci are a voxel or two thick and off by up to half of one on either side: a half.
    """
    other = knee.build(knee.load("knee"), voxel_mm).volumes_ml()
    for name, structure in structures().items():
        part = 0.02 if structure.kind == "bone" else 0.5
        assert other[structure.number] == pytest.approx(built.volumes_ml()[structure.number], rel=part), name


def test_a_left_knee_is_the_mirrored_right_one(built: LabelVolume, tmp_path: Path) -> None:
    path = tmp_path / "left.toml"
    path.write_text(
        (ROOT / "trainer/anatomy/data/knees/knee.toml").read_text().replace('side = "right"', 'side = "left"')
    )
    left = knee.build(knee.load(str(path)), 1.0)
    bones = [s.number for s in structures().values() if s.kind != "ligament"]
    keep = np.isin(np.arange(256), bones)
    np.testing.assert_array_equal(
        np.where(keep[left.labels], left.labels, 0), np.where(keep[built.labels], built.labels, 0)[::-1]
    )
    for number in (11, 12):
        assert left.volumes_ml()[number] == pytest.approx(built.volumes_ml()[number], rel=0.1)


@pytest.mark.parametrize("voxel_mm", [0.0, 0.1, 3.0, float("nan")])
def test_an_impossible_resolution_is_refused(voxel_mm: float) -> None:
    with pytest.raises(ConfigError, match=r"voxels of 0.15 to 2.0 mm"):
        knee.build(knee.load("knee"), voxel_mm)


def test_cruciates_join_both_bones_and_cover_nothing(built: LabelVolume) -> None:
    """Each touches femur and tibia; nothing that was there before is lost; the anterior one comes from the outer
    condyle and runs to the front, the posterior one from the inner condyle to the back (a right knee)."""
    from scipy.ndimage import binary_dilation

    for name, forwards in zip(ligaments.CRUCIATES, (True, False), strict=True):
        inside = built.labels == number_of(name)
        near = set(np.unique(built.labels[binary_dilation(inside)]).tolist())
        assert {number_of("femur"), number_of("tibia")} <= near
        points = built.points_mm(number_of(name))
        upper, lower = points[points[:, 2] > points[:, 2].mean()], points[points[:, 2] < points[:, 2].mean()]
        run = lower.mean(axis=0) - upper.mean(axis=0)
        assert (run[1] < 0.0) == forwards
        assert (upper[:, 0].mean() < lower[:, 0].mean()) == forwards


def test_a_knee_without_a_femur_has_no_cruciates_and_says_so(built: LabelVolume) -> None:
    labels = np.where((built.labels == 1) | (built.labels > 10), 0, built.labels).astype(np.uint8)
    volume, swept, failed = ligaments.swept_cruciates(
        LabelVolume(labels, built.spacing_mm, built.lps_from_volume), "right"
    )
    np.testing.assert_array_equal(volume.labels, labels)
    assert swept == {}
    assert failed == dict.fromkeys(ligaments.CRUCIATES, "no femur")


def mesh_of(surface: surfaces.Surface) -> trimesh.Trimesh:
    return trimesh.Trimesh(surface.points, surface.triangles, process=False)


@pytest.mark.parametrize("name", structures())
def test_surfaces_are_closed_face_outwards_and_enclose_their_voxels(name: str, built: LabelVolume) -> None:
    """Volume within 1 % of the voxels', positive: normals point outwards."""
    number = number_of(name)
    surface = surfaces.surface_of(built, number)
    mesh = mesh_of(surface)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert surface.volume_ml() == pytest.approx(built.volumes_ml()[number], rel=0.01)
    low, high = (
        np.argwhere(built.labels == number).min(axis=0) - 1,
        np.argwhere(built.labels == number).max(axis=0) + 1,
    )
    assert np.all(surface.points >= low * built.spacing_mm)
    assert np.all(surface.points <= high * built.spacing_mm)


def test_a_ball_has_the_surface_of_a_ball() -> None:
    """Voxels of 0.5 × 0.5 × 1 mm, R = 10 mm: vertices within half a voxel's diagonal (0.61 mm) of the sphere."""
    at = np.indices((48, 48, 24)).transpose(1, 2, 3, 0) * [0.5, 0.5, 1.0] - [11.75, 11.75, 11.5]
    labels = (np.linalg.norm(at, axis=-1) < 10.0).astype(np.uint8)
    surface = surfaces.surface_of(LabelVolume(labels, (0.5, 0.5, 1.0), Rigid.identity()), 1)
    radius = np.linalg.norm(surface.points - [11.75, 11.75, 11.5], axis=1)
    assert np.abs(radius - 10.0).max() < 0.61
    assert mesh_of(surface).is_watertight


def test_structures_too_small_to_smooth_still_have_a_closed_surface() -> None:
    """One voxel, a line and a sheet of one voxel, at the grid's edge."""
    for shape in ([1, 1, 1], [1, 1, 9], [1, 9, 9]):
        labels = np.zeros((9, 9, 9), dtype=np.uint8)
        labels[: shape[0], : shape[1], : shape[2]] = 3
        surface = surfaces.surface_of(LabelVolume(labels, (1.0, 1.0, 1.0), Rigid.identity()), 3)
        assert mesh_of(surface).is_watertight
        assert surface.volume_ml() > 0.0
    with pytest.raises(ValueError, match="no voxel has the label 4"):
        surfaces.surface_of(LabelVolume(labels, (1.0, 1.0, 1.0), Rigid.identity()), 4)


def test_import_makes_a_knee_with_its_origin(scan: Path, built: LabelVolume, tmp_path: Path) -> None:
    out = tmp_path / "mine"
    record = imported.import_volume(scan, write_map(tmp_path), out)
    made = imported.load(out)
    assert made.side == "right"
    assert json.loads((out / "anatomy.json").read_text()) == record == imported.read_record(out)
    assert record["source"]["sha256"] == volume_file.read(scan).sha256
    assert record["label_map"]["labels"]["21"] == "femur"
    assert set(record["swept"]) == set(ligaments.CRUCIATES)
    assert record["missing"] == []
    for row in record["structures"]:
        assert trimesh.load(out / row["surface"]).is_watertight
        if row["number"] <= 10:
            assert row["volume_ml"] == pytest.approx(built.volumes_ml()[row["number"]], rel=1e-9)
    # Made from the same bones in the same place, the ligaments are the built-in knee's.
    np.testing.assert_array_equal(made.volume.labels, built.labels)
    with pytest.raises(ConfigError, match="is there already"):
        imported.import_volume(scan, write_map(tmp_path), out)


def test_a_knee_is_found_by_its_name_or_folder(scan: Path, built: LabelVolume, tmp_path: Path) -> None:
    imported.import_volume(scan, write_map(tmp_path), tmp_path / "mine")
    for anatomy in (library.load("knee", 1.0), library.load(str(tmp_path / "mine"))):
        np.testing.assert_array_equal(anatomy.volume.labels, built.labels)
        assert anatomy.side == "right"
    with pytest.raises(ConfigError, match="no knee 'elbow': expected knee, or a folder"):
        library.load("elbow")


def test_labels_may_be_large_numbers(scan: Path, tmp_path: Path) -> None:
    """Labels of two bytes, as whole-body segmentations have them."""
    file = volume_file.read(scan)
    write_nrrd(
        tmp_path / "large.nrrd",
        np.where(file.values > 0, file.values * 100.0, 0.0).astype(np.uint16),
        file.lps_from_index,
    )
    changes = {str(k): "" for k in range(21, 31)} | {
        str(100 * (k + 20)): n for k, n in enumerate(structures(), 1) if k <= 10
    }
    record = imported.import_volume(tmp_path / "large.nrrd", write_map(tmp_path, changes), tmp_path / "mine")
    assert len(record["structures"]) == 12


def test_import_resamples(scan: Path, tmp_path: Path) -> None:
    record = imported.import_volume(scan, write_map(tmp_path), tmp_path / "mine", 1.5)
    assert record["spacing_mm"] == [1.5, 1.5, 1.5]
    with pytest.raises(ConfigError, match="--spacing-mm 0"):
        imported.import_volume(scan, write_map(tmp_path), tmp_path / "other", 0.0)


def test_a_folder_that_is_no_anatomy_is_told(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no imported anatomy: it has no anatomy\.json"):
        imported.load(tmp_path)
    (tmp_path / "anatomy.json").write_text("{")
    with pytest.raises(ConfigError, match="cannot be read"):
        imported.load(tmp_path)


WRONG_MAPS = {
    "labels 31, 32, 33 are not in": {"31": "ignored", "32": "ignored", "33": "ignored"},
    "label 30 is? .*not named": {"30": ""},
    "no structure 'femurr', did you mean 'femur'": {"21": "femurr"},
    "no structure 'brain'": {"21": "brain"},
    "two labels are the femur": {"22": "femur"},
    "'x' is no label": {"x": "femur"},
    "'0' is no label": {"0": "femur"},
    "the femur lies below the tibia": {"21": "tibia", "22": "femur"},
    "the patella lies below the tibia": {"23": "fibula", "24": "patella"},
    "medial and lateral are exchanged": {"29": "lateral meniscus", "30": "medial meniscus"},
    "the patella is smaller than the patellar cartilage": {"23": "patellar cartilage", "28": "patella"},
}


@pytest.mark.parametrize("message", WRONG_MAPS)
def test_a_wrong_label_map_is_one_line(message: str, scan: Path, tmp_path: Path) -> None:
    out = tmp_path / "mine"
    with pytest.raises(ConfigError, match=message) as caught:
        imported.import_volume(scan, write_map(tmp_path, WRONG_MAPS[message]), out)
    assert "\n" not in str(caught.value)
    assert not out.exists()


def flipped(scan: Path, axis: int) -> Path:
    """The same voxels in a file that says the opposite of one of the patient's axes."""
    file = volume_file.read(scan)
    affine = file.lps_from_index.copy()
    affine[axis] *= -1.0
    path = scan.with_name(f"flipped{axis}.nrrd")
    write_nrrd(path, file.values, affine)
    return path


@pytest.mark.parametrize(("axis", "message"), [(1, "front and back are exchanged"), (2, "up and down are exchanged")])
def test_a_file_that_lies_about_front_or_up_is_told(axis: int, message: str, scan: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=message):
        imported.import_volume(flipped(scan, axis), write_map(tmp_path), tmp_path / "mine")


def test_exchanged_sides_show_against_the_stated_side(scan: Path, tmp_path: Path) -> None:
    """A mirrored right knee is a left one; only a map that says which knee it is can tell that the file is wrong."""
    mirrored = flipped(scan, 0)
    with pytest.raises(ConfigError, match="the label map says a right knee, the bones are a left one's"):
        imported.import_volume(mirrored, write_map(tmp_path, side="right"), tmp_path / "mine")
    given = label_map.read(write_map(tmp_path))
    assert inspection.describe(volume_file.read(mirrored), given)["side"] == "left"
    assert inspection.describe(volume_file.read(scan), given)["side"] == "right"


def test_every_shipped_map_is_in_order_and_ours_is_recognised(built: LabelVolume, tmp_path: Path) -> None:
    assert {Path(m.path).stem for m in label_map.shipped()} == {"mskt", "trainer"}
    write_ours(built, tmp_path / "ours.nrrd")
    found = inspection.describe(volume_file.read(tmp_path / "ours.nrrd"), None)
    assert Path(found["label_map"]).stem == "trainer"
    assert found["missing"] == []


def test_a_volume_that_no_map_fits_says_so(scan: Path) -> None:
    found = inspection.describe(volume_file.read(scan), None)
    assert found["label_map"] is None
    assert "no shipped label map fits" in found["problems"][0]
    assert len(found["labels"]) == 10


@real_knee
def test_the_real_knee_is_inspected_as_published() -> None:
    """Volumes within 1 % of the table, whose one decimal is worth half of its last digit; right; no ligaments."""
    found = inspection.describe(volume_file.read(REAL), None)
    np.testing.assert_allclose(found["spacing_mm"], [0.3646, 0.3646, 0.70], atol=5e-5)
    assert (found["orientation"], found["side"], found["problems"]) == ("PIR", "right", [])
    assert found["missing"] == list(ligaments.CRUCIATES)
    assert {row["structure"] for row in found["labels"]} == set(PUBLISHED)
    for row in found["labels"]:
        assert row["volume_ml"] == pytest.approx(PUBLISHED[row["structure"]], rel=0.01, abs=0.05)


def cruciate_footprints(bone: str) -> tuple[Array, Array]:
    """Centres of the two footprints on a mean bone: points that half of the specimens cover, in two clusters."""
    from scipy.cluster.vq import kmeans2

    rows = np.loadtxt(SHARED / f"data_{bone}_meanshape_ligs_color.xyz")
    points = rows[rows[:, 3] >= 5.0, :3]
    _, cluster = kmeans2(points, 2, seed=1, minit="++")
    return points[cluster == 0].mean(axis=0), points[cluster == 1].mean(axis=0)


@real_knee
def test_the_real_knees_swept_cruciates_are_as_far_apart_on_the_tibia_as_in_other_knees(tmp_path: Path) -> None:
    """An independent measure: the mean tibia's footprints (Wesseling) lie as far apart as ours, within 6 mm.

    Assumed: footprints' centres spread by some 3 mm from knee to knee, twice that is allowed.
    """
    file, given = volume_file.read(REAL), label_map.read(MSKT)
    volume = imported.sorted_axes(file, given.renumber())
    coarse = resample(volume, (0.9, 0.9, 0.9))
    _, swept, failed = ligaments.swept_cruciates(coarse, "right")
    assert failed == {}
    ours = [np.mean(swept[name]["tibia_mm"], axis=0) for name in ligaments.CRUCIATES]
    a, b = cruciate_footprints("tibia")
    assert np.linalg.norm(ours[0] - ours[1]) == pytest.approx(np.linalg.norm(a - b), abs=6.0)
    for name in ligaments.CRUCIATES:
        slack = np.mean([bundle.slack_length_mm for bundle in ligaments.ligaments().of(name)])
        # A ligament near its slack length when the knee is straight: within a quarter (assumed).
        assert swept[name]["length_mm"] == pytest.approx(slack, rel=0.25)
