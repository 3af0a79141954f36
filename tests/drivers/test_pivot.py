"""A sweep about the resting tip tells where the tip is, how surely, and whether it tells at all."""

from __future__ import annotations

import numpy as np
import pytest

from trainer.calibration import CalibrationError
from trainer.drivers import pivot
from trainer.geometry import Array, matrix_from_quaternion, quaternion_from_axis_angle, quaternion_multiply

TIP = np.array([3.0, -2.0, 110.0])
CENTRE = np.array([220.0, -30.0, 60.0])
NOISE_MM = np.sqrt(0.06**2 + (36 * 25.4 / 8192) ** 2 / 12)  # as in test_touched_points


def cone(rng: np.random.Generator, n: int = 300, half_angle_deg: float = 35.0) -> Array:
    """Quaternions of tilts to every side, up to an angle, with a little twist."""
    side = rng.uniform(0, 2 * np.pi, n)
    tilt = np.radians(half_angle_deg) * np.sqrt(rng.uniform(size=n))
    twist = rng.uniform(-0.5, 0.5, n)
    zero, sine = np.zeros(n), np.sin(tilt / 2)
    tilted = np.stack([np.cos(tilt / 2), sine * np.cos(side), sine * np.sin(side), zero], axis=1)
    return quaternion_multiply(tilted, np.stack([np.cos(twist / 2), zero, zero, np.sin(twist / 2)], axis=1))


def positions(quaternion: Array) -> Array:
    """Where the sensor is while its tip rests at CENTRE."""
    return np.asarray(CENTRE - matrix_from_quaternion(quaternion) @ TIP)


def test_without_noise_tip_and_pivot_are_found() -> None:
    """Rounding of 300 mm, 6e-14, times the condition number, 5, times a dozen operations."""
    q = cone(np.random.default_rng(0))
    found = pivot.fit(positions(q), q)
    np.testing.assert_allclose(found.tip, TIP, rtol=0, atol=1e-11)
    np.testing.assert_allclose(found.pivot, CENTRE, rtol=0, atol=1e-11)
    assert found.residual_mm < 1e-11


def test_with_a_tracker_s_noise_the_tip_is_within_a_twentieth_of_a_millimetre_and_as_sure_as_is_said() -> None:
    """100 sweeps of 300 poses. The stated sd is that of the least certain axis, so the largest of three. The rms
    of 100 errors along one axis has a relative sd of 1 / √200, 7 %: five of them.
    """
    rng = np.random.default_rng(1)
    errors, said = [], []
    for _ in range(100):
        q = cone(rng)
        found = pivot.fit(positions(q) + rng.normal(scale=NOISE_MM, size=(len(q), 3)), q)
        errors.append(found.tip - TIP)
        said.append(found.uncertainty_mm)
        assert found.residual_mm == pytest.approx(np.sqrt(3) * NOISE_MM, rel=0.2)
    assert np.linalg.norm(errors, axis=1).max() < 0.05
    each = np.sqrt(np.mean(np.square(errors), axis=0))
    assert 0.65 * np.mean(said) < each.max() < 1.35 * np.mean(said)


@pytest.mark.parametrize("half_angle_deg", [0.0, 1.0, 5.0, 10.0])
def test_a_sweep_that_hardly_turns_is_refused(half_angle_deg: float) -> None:
    rng = np.random.default_rng(2)
    side = rng.uniform(0, 2 * np.pi, 300)
    tilt = np.radians(half_angle_deg) * np.sqrt(rng.uniform(size=300))
    q = np.array([quaternion_from_axis_angle([np.cos(s), np.sin(s), 0], a) for s, a in zip(side, tilt, strict=True)])
    with pytest.raises(CalibrationError, match=r"hardly turns, or about one axis only: condition number .* at most 12"):
        pivot.fit(positions(q), q)


@pytest.mark.parametrize("noise_deg", [0.0, 0.022, 0.5])
def test_a_sweep_about_one_axis_is_refused_however_far_it_goes(noise_deg: float) -> None:
    """Also with a tracker's noise of orientation (0.022° is a step of its words), which turns about another axis."""
    rng = np.random.default_rng(3)
    q = np.array([quaternion_from_axis_angle([0.6, 0.0, 0.8], a) for a in np.linspace(-1.5, 1.5, 200)])
    p = positions(q)
    shake = np.radians(noise_deg) * rng.normal(size=200)
    shaken = [quaternion_multiply(quaternion_from_axis_angle([1, 0, 0], s), a) for s, a in zip(shake, q, strict=True)]
    with pytest.raises(CalibrationError, match="about one axis only: condition number"):
        pivot.fit(p, np.array(shaken))


def test_a_tip_that_slipped_is_refused() -> None:
    """By 8 mm at half time: the residual cannot be below half of that in rms, 4 mm, less what the tip's fit takes."""
    q = cone(np.random.default_rng(4))
    p = positions(q)
    p[150:, 0] += 8.0
    with pytest.raises(CalibrationError, match=r"the tip did not rest during the sweep: residual [34]\.\d\d mm"):
        pivot.fit(p, q)


def test_too_few_poses_are_refused() -> None:
    q = cone(np.random.default_rng(5), n=9)
    with pytest.raises(CalibrationError, match="the sweep holds 9 poses, at least 10"):
        pivot.fit(positions(q), q)
