"""A^-1 recovers fields it has not seen, as well as the noise of the calibration allows."""

import time
from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest
import scipy.sparse

from fibre import (
    BasisPursuit,
    Fibrelets,
    ForwardInverse,
    Inverse,
    Ridge,
    WeightedSum,
    basis_pursuit_denoise,
    recover,
    retrieve_fields,
)
from fibre.calibration import columns
from fibre.coupling import clean_fibrelets
from tests.fibre.benches import METHOD
from tests.fibre.scenes import complex_noise, scene

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
    return recover(standard.calibration(NOISE, 1), ForwardInverse())


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
    errors = {s: error(recover(fields, ForwardInverse(strength=s)), standard, z) for s in (0.0, 0.01, 1.0, 100.0)}
    assert errors[1.0] < 0.1 * errors[0.0]
    assert errors[1.0] < 0.9 * errors[0.01]
    assert errors[1.0] < 0.7 * errors[100.0]


def test_smooth_fields_are_never_amplified(standard, inverse):
    z = held_out(standard)["smooth"]
    assert error(inverse, standard, z) < 0.2
    assert error(inverse, standard, z) < error(inverse, standard, held_out(standard)["rough"])


def test_less_noise_is_less_error(standard):
    z = held_out(standard)["rough"]
    errors = [
        error(recover(standard.calibration(n, 1), ForwardInverse()), standard, z) for n in (1e-3, 1e-2, 3e-2, 1e-1)
    ]
    assert errors == sorted(errors)
    assert errors[-1] < 1.0  # even then it is no worse than to answer zero


def test_light_between_sparse_points_is_kept_out_and_costs_those_at_the_points_little():
    """Points as far apart as the published ones, three fibrelets to each; a sample lights those in between too."""
    sparse = scene(grid=(6, 6), pitch=7.6e-6, radius=34e-6, reference=(0.0, 31e-6))
    points = sparse.plan.points
    assert sparse.bundle.cores > 2.5 * len(points)
    offsets = [np.array([a, b]) for a in (-1.9e-6, 1.9e-6) for b in (-1.9e-6, 1.9e-6)]
    finer = np.concatenate([points + offset for offset in offsets])
    launch = sparse.bundle.launch(finer, 3.8e-6)
    flat = np.repeat(np.eye(2), len(finer), axis=0)  # H alone, V alone
    flat = sparse.bundle.columns(scipy.sparse.block_diag([launch, launch])) @ flat
    rough = complex_noise(np.random.default_rng(0), (72, 40))
    errors, mixed = {}, {}
    for between in (0.0, ForwardInverse().between):
        inverse = recover(sparse.calibration(1e-4, 1), ForwardInverse(between=between))
        jones = (inverse.matrix @ flat).reshape(2, 36, 2).swapaxes(0, 1)
        jones = jones / (np.trace(jones, axis1=1, axis2=2) / 2)[:, None, None]  # as measured against a blank
        errors[between] = np.median(np.linalg.norm(jones - np.eye(2), axis=(1, 2)))
        own = inverse.matrix @ (sparse.matrix @ rough)
        mixed[between] = np.linalg.norm(own - rough) / np.linalg.norm(rough)
    own = ForwardInverse().between
    assert errors[own] < 0.25 * errors[0.0]
    assert mixed[own] < 0.01  # and their amplitude is right


def test_a_window_too_small_costs_and_a_large_one_does_not(standard, inverse):
    fields, z = standard.calibration(NOISE, 1), held_out(standard)["rough"]
    narrow, wide = (error(recover(fields, ForwardInverse(window=w)), standard, z) for w in (8e-6, 60e-6))
    own = error(inverse, standard, z)
    assert narrow > 1.1 * own
    assert wide < 1.1 * own


def test_the_inverse_keeps_its_calibration_and_its_regularisation(standard, inverse):
    assert isinstance(inverse, Inverse)
    assert inverse.matrix.shape == (128, 2 * standard.bundle.cores)
    assert inverse.calibration.grid == (8, 8)
    again = recover(standard.calibration(NOISE, 1), ForwardInverse(strength=3.0))
    assert again.ridge == pytest.approx(3 * inverse.ridge)


def test_the_unit_of_the_calibration_is_divided_out(standard, inverse):
    fields = standard.calibration(NOISE, 1)
    scaled = recover(replace(fields, fields=1e3 * fields.fields, variance=1e6 * fields.variance), ForwardInverse())
    np.testing.assert_allclose(1e3 * scaled.matrix.toarray(), inverse.matrix.toarray(), rtol=1e-5, atol=1e-6)
    assert scaled.ridge == pytest.approx(inverse.ridge)


def test_wrong_arguments_are_named(standard):
    fields = standard.calibration(NOISE, 1)
    with pytest.raises(TypeError, match="calibration_fields must be CalibrationFields"):
        recover(np.eye(3), ForwardInverse())
    with pytest.raises(TypeError, match="method must be RecoveryMethod"):
        recover(fields, "ridge")
    with pytest.raises(ValueError, match="holds no usable fibrelet at point"):
        recover(fields, ForwardInverse(window=0.5e-6))


METHODS = {"forward": ForwardInverse(), "ridge": Ridge(), "pursuit": BasisPursuit(together=1), "sum": WeightedSum()}


@pytest.fixture(scope="module")
def inverses(standard):
    return {name: recover(standard.calibration(NOISE, 1), method) for name, method in METHODS.items()}


def test_methods_that_invert_are_better_than_the_one_that_does_not():
    single = scene(stride=8)  # one spot at a time
    z, calibration = held_out(single)["rough"], single.calibration(NOISE, 1)
    errors = {name: error(recover(calibration, method), single, z) for name, method in METHODS.items()}
    assert errors["forward"] < errors["ridge"] < 0.5 * errors["sum"]
    assert errors["pursuit"] < 2 * errors["ridge"]


def test_only_the_forward_route_tells_close_spots_apart_that_are_always_lit_together(standard, inverses):
    z = held_out(standard)["rough"]
    assert error(inverses["forward"], standard, z) < 0.3 * error(inverses["ridge"], standard, z)


def window_of(standard, points, side=27e-6):
    positions = standard.plan.points[points]
    middle = (positions.min(0) + positions.max(0)) / 2
    near = np.abs(standard.bundle.centres - middle).max(1) <= side / 2
    return np.flatnonzero(np.tile(near & clean_fibrelets(standard.calibration(NOISE, 1)), 2))


def test_ridge_rows_are_dense_tikhonov_regression(standard, inverses):
    fields, point = standard.calibration(NOISE, 1), 27
    chosen = window_of(standard, [point], 4 * 4.2e-6)  # up to the next spot that is lit with it
    y = fields.fields.reshape(len(fields.fields), -1)[:, chosen]
    penalty = fields.variance.sum(0).ravel()[chosen]
    x = fields.inputs.toarray()[[point, point + 64]]
    expected = np.linalg.lstsq(np.vstack([y, np.diag(np.sqrt(penalty))]),
                               np.vstack([x.T, np.zeros((len(chosen), 2))]), rcond=None)[0].T  # fmt: skip
    found = inverses["ridge"].matrix.toarray()[[point, point + 64]]
    np.testing.assert_allclose(found[:, chosen], expected, atol=1e-8 * np.abs(expected).max())
    assert np.count_nonzero(found) == np.count_nonzero(expected)


def test_pursued_rows_leave_the_residual_that_was_asked_for_and_are_the_least(standard):
    fields, delta = standard.calibration(NOISE, 1), 0.06
    method = BasisPursuit(delta=delta, window=27e-6, together=1)
    matrix = recover(fields, method).matrix.toarray()
    y, x = fields.fields.reshape(len(fields.fields), -1), fields.inputs.toarray()
    residual = np.linalg.norm(matrix @ y.T - x, axis=1)
    assert residual.max() <= 1.001 * delta
    chosen = window_of(standard, [30])
    ridge = recover(fields, Ridge(strength=1e-6, window=27e-6)).matrix.toarray()[30]  # another row within the residual
    assert np.linalg.norm(ridge @ y.T - x[30]) < delta
    assert np.abs(matrix[30]).sum() < np.abs(ridge).sum()
    again = basis_pursuit_denoise(y[:, chosen], x[[30]].T, delta, tolerance=1e-6)
    assert np.abs(matrix[30]).sum() == pytest.approx(np.abs(again.x).sum(), rel=2e-3)


def test_neighbours_that_share_a_window_get_nearly_the_same_rows(standard):
    fields, z = standard.calibration(NOISE, 1), held_out(standard)["rough"]
    alone, shared = (error(recover(fields, BasisPursuit(together=t)), standard, z) for t in (1, 2))
    assert shared == pytest.approx(alone, rel=0.2)


def test_weighted_sums_are_exact_where_points_are_far_apart():
    far = scene(grid=(2, 2), stride=2, radius=30e-6)
    far = replace(far, plan=replace(far.plan, pitch=30e-6), reference=far.reference)
    launch = far.bundle.launch(far.plan.points, 2.5e-6)
    far = replace(far, matrix=far.bundle.columns(scipy.sparse.block_diag([launch, launch])).toarray())
    inverse = recover(far.calibration(1e-6, 1), WeightedSum(window=20e-6))
    np.testing.assert_allclose(inverse.matrix @ far.matrix, np.eye(8), atol=2e-3)


class Stopping(Ridge):
    """Interrupted after some rows, until told to go on."""

    left: ClassVar = [100]

    def rows(self, prepared, points, chosen):
        if self.left[0] == 0:
            raise KeyboardInterrupt
        self.left[0] -= 1
        return super().rows(prepared, points, chosen)


def test_an_interrupted_recovery_goes_on_where_it_was(tmp_path):
    wide = scene(grid=(10, 14), stride=5, radius=32e-6, reference=(0.0, 30e-6))
    fields = wide.calibration(NOISE, 1)
    with pytest.raises(KeyboardInterrupt):
        recover(fields, Stopping(), folder=tmp_path / "kept")
    Stopping.left[0] = 10_000
    found = recover(fields, Stopping(), folder=tmp_path / "kept")
    assert 10_000 - Stopping.left[0] == 140 - 64  # of 140 points 64 were finished and kept
    np.testing.assert_array_equal(found.matrix.toarray(), recover(fields, Ridge()).matrix.toarray())
    with pytest.raises(ValueError, match="belongs to another calibration or method"):
        recover(fields, Ridge(strength=2.0), folder=tmp_path / "kept")


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda: Ridge(window=0.0), "window must be > 0"),
        (lambda: Ridge(strength=-1.0), "strength must be >= 0"),
        (lambda: WeightedSum(window=-1.0), "window must be > 0"),
        (lambda: BasisPursuit(delta=-1.0), "delta must be >= 0"),
        (lambda: BasisPursuit(together=0), "together must be >= 1"),
    ],
)
def test_settings_out_of_range_are_named(call, text):
    with pytest.raises(ValueError, match=text):
        call()


def test_the_cost_said_before_is_about_what_it_takes(standard):
    """Counts exactly; seconds only as a number that can be believed within a factor of ten on a busy machine."""
    fields, method = standard.calibration(0.01, 1), ForwardInverse()
    cost = method.cost(fields)
    start = time.perf_counter()
    inverse = recover(fields, method)
    spent = time.perf_counter() - start
    assert cost.rows == inverse.matrix.shape[0]
    assert cost.equations == len(fields.fields)
    assert cost.bytes == pytest.approx(inverse.matrix.nnz * 20, rel=0.3)
    assert spent / 10 < cost.seconds < 10 * spent
    assert f"{cost.rows} rows" in str(cost)


def test_a_window_of_pixels_recovers_what_fibrelets_do(bench):
    """The same images kept in pixels of a window; the sample's fields come out alike, at the points in its middle."""
    frame, size = bench.calibration.images.frame, bench.calibration.images.pixel_size
    pixels = Fibrelets.pixels(frame, size, slice(20, 76, 2), slice(20, 76, 2))
    fields = retrieve_fields(bench.calibration, METHOD, pixels)
    recording = retrieve_fields(bench.recording, METHOD, pixels)
    found, usual = (
        recover(record, Ridge(window=16e-6)).matrix @ seen.reshape(3, -1).T
        for record, seen in ((fields, recording.blank), (bench.calibration_fields, bench.recording_fields.blank))
    )
    middle = np.flatnonzero(np.tile(np.abs(bench.calibration.points).max(1) < 8e-6, 2))
    turned = found * np.exp(1j * np.angle((found.conj() * usual).sum()))
    error = np.linalg.norm((turned - usual)[middle]) / np.linalg.norm(usual[middle])
    assert error < 0.1
