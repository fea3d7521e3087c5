"""A^-1 recovers fields it has not seen, as well as the noise of the calibration allows."""

import numpy as np
import pytest

from fibre import Inverse, Ridge, recover
from fibre.calibration import clean_fibrelets, columns
from tests.fibre.scenes import complex_noise

NOISE = 0.01


def held_out(standard, count=40):
    """Random fields at the points, and smooth ones, (2 p, s)."""
    generator = np.random.default_rng(11)
    rough = complex_noise(generator, (128, count))
    smooth = (standard.smooth_sample() @ standard.plan.illumination).swapaxes(0, 1).reshape(128, 3)
    return {"rough": rough, "smooth": smooth}


def error(inverse, standard, z, noise=0.0):
    seen = standard.matrix @ z
    seen = seen + noise * complex_noise(np.random.default_rng(12), seen.shape)
    return np.linalg.norm(inverse.matrix @ seen - z) / np.linalg.norm(z)


@pytest.fixture(scope="module")
def inverse(standard):
    return recover(standard.calibration(NOISE, 1), Ridge())


def test_rows_are_the_dense_ridge_solution_of_their_window(standard, inverse):
    fields = standard.calibration(NOISE, 1)
    known = columns(fields)
    a, penalty = known.values.toarray(), known.variance.toarray().sum(1)
    point, m = 20, standard.bundle.cores
    near = np.abs(standard.bundle.centres - standard.plan.points[point]).max(1) <= 13.5e-6
    rows = np.flatnonzero(np.tile(near, 2) & (np.abs(a).sum(1) > 0))
    # min |e - a A|^2 + sum |a|^2 L as one least-squares problem
    stacked = np.concatenate([a[rows], np.diag(np.sqrt(penalty[rows]))], axis=1)
    for p in range(2):
        target = np.zeros(stacked.shape[1])
        target[point + 64 * p] = 1
        expected = np.linalg.lstsq(stacked.T, target + 0j, rcond=None)[0]
        found = inverse.matrix.toarray()[point + 64 * p]
        np.testing.assert_allclose(found[rows], expected, atol=1e-8 * np.abs(expected).max())
        assert np.count_nonzero(found) <= len(rows) <= 2 * m


def test_held_out_fields_are_recovered_as_well_as_the_noise_allows(standard, inverse):
    """Witness: the error that the best dense estimator must expect when the true A is known but for that noise.

    Smooth fields are not held to it: what stays ambiguous between spots lit together adds up over neighbours.
    """
    fields, z = standard.calibration(NOISE, 1), held_out(standard)["rough"]
    rows = np.flatnonzero(np.tile(clean_fibrelets(fields), 2))
    a = standard.matrix[rows]
    penalty = columns(fields).variance.toarray()[rows].sum(1)
    oracle = a.conj().T @ np.linalg.inv(a @ a.conj().T + np.diag(penalty))
    expected = np.linalg.norm(oracle @ a - np.eye(128)) ** 2 + np.sum(np.abs(oracle) ** 2 * penalty)
    assert error(inverse, standard, z) < 1.4 * np.sqrt(expected / 128)


@pytest.mark.filterwarnings("ignore:An ill-conditioned matrix")
def test_the_noises_own_strength_beats_none_and_too_much(standard, inverse):
    fields, z = standard.calibration(NOISE, 1), held_out(standard)["rough"]
    errors = {s: error(recover(fields, Ridge(strength=s)), standard, z) for s in (0.0, 0.01, 1.0, 100.0)}
    assert errors[1.0] < 0.1 * errors[0.0]
    assert errors[1.0] < 0.9 * errors[0.01]
    assert errors[1.0] < 0.7 * errors[100.0]


def test_smooth_fields_are_never_amplified(standard, inverse):
    z = held_out(standard)["smooth"]
    assert error(inverse, standard, z) < 0.2
    assert error(inverse, standard, z) < error(inverse, standard, held_out(standard)["rough"])


def test_less_noise_is_less_error(standard):
    z = held_out(standard)["rough"]
    errors = [error(recover(standard.calibration(n, 1), Ridge()), standard, z) for n in (1e-3, 1e-2, 3e-2, 1e-1)]
    assert errors == sorted(errors)
    assert errors[-1] < 1.0  # even then it is no worse than to answer zero


def test_a_window_too_small_costs_and_a_large_one_does_not(standard, inverse):
    fields, z = standard.calibration(NOISE, 1), held_out(standard)["rough"]
    narrow, wide = (error(recover(fields, Ridge(window=w)), standard, z) for w in (8e-6, 60e-6))
    own = error(inverse, standard, z)
    assert narrow > 1.1 * own
    assert wide < 1.1 * own


def test_the_inverse_keeps_its_calibration_and_its_regularisation(standard, inverse):
    assert isinstance(inverse, Inverse)
    assert inverse.matrix.shape == (128, 2 * standard.bundle.cores)
    assert inverse.calibration.grid == (8, 8)
    again = recover(standard.calibration(NOISE, 1), Ridge(strength=3.0))
    assert again.ridge == pytest.approx(3 * inverse.ridge)


def test_the_unit_of_the_calibration_is_divided_out(standard, inverse):
    from dataclasses import replace

    fields = standard.calibration(NOISE, 1)
    scaled = recover(replace(fields, fields=1e3 * fields.fields, variance=1e6 * fields.variance), Ridge())
    np.testing.assert_allclose(1e3 * scaled.matrix.toarray(), inverse.matrix.toarray(), rtol=1e-5, atol=1e-6)
    assert scaled.ridge == pytest.approx(inverse.ridge)


def test_wrong_arguments_are_named(standard):
    fields = standard.calibration(NOISE, 1)
    with pytest.raises(TypeError, match="calibration_fields must be CalibrationFields"):
        recover(np.eye(3), Ridge())
    with pytest.raises(TypeError, match="method must be RecoveryMethod"):
        recover(fields, "ridge")
    with pytest.raises(ValueError, match="holds no usable fibrelet at point"):
        recover(fields, Ridge(window=0.5e-6))
