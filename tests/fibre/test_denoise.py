"""Basis pursuit denoising: the least norm within the residual, certified, at any scale, for many at once."""

import numpy as np
import pytest
import scipy.optimize
from hypothesis import given, settings
from hypothesis import strategies as st

from fibre import DenoiseStatus, basis_pursuit_denoise


def cn(rng, *shape):
    return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2)


def problem(seed, m=30, n=80, k=3, nonzero=4, noise=0.02, kind="random"):
    """Matrix, data, residuals that the truth has, and the truth."""
    rng = np.random.default_rng(seed)
    a = cn(rng, m, n)
    if kind == "grouped":  # ten neighbouring columns see one fibrelet
        a = np.repeat(cn(rng, m, -(-n // 10)), 10, axis=1)[:, :n] + 0.03 * a
    if kind == "scaled":
        a = a * 10 ** rng.uniform(-3, 3, n)
    if kind == "decaying":
        a = a * np.exp(-np.arange(n) / 10)
    x = np.zeros((n, k), complex)
    for j in range(k):
        x[rng.choice(n, nonzero, replace=False), j] = cn(rng, nonzero)
    error = noise * np.linalg.norm(a @ x, axis=0) / np.sqrt(m) * cn(rng, m, k)
    return a, a @ x + error, np.linalg.norm(error, axis=0), x


def test_real_problems_are_those_of_a_linear_program():
    """With delta = 0 and real data it is min |x|_1 with A x = b: SciPy's simplex is the witness."""
    rng = np.random.default_rng(0)
    a, b = rng.standard_normal((15, 40)), rng.standard_normal((15, 4))
    found = basis_pursuit_denoise(a, b, 0.0, tolerance=1e-3, iterations=20_000)
    assert not found.status.any()
    for j in range(4):
        least = scipy.optimize.linprog(np.ones(80), A_eq=np.hstack([a, -a]), b_eq=b[:, j], method="highs").fun
        norm = np.abs(found.x[:, j]).sum()
        assert least * (1 - 1e-9) <= norm <= least / (1 - found.gap[j]) + 1e-9 * least
        assert found.gap[j] <= 1e-3
    np.testing.assert_allclose(found.x.imag, 0, atol=1e-9)


def test_complex_problems_meet_the_conditions_of_optimality():
    """b - A x is parallel to a multiplier whose A^H has the phase and size of a subgradient of the norm."""
    a, b, delta, _ = problem(1)
    found = basis_pursuit_denoise(a, b, delta, tolerance=1e-7, iterations=50_000)
    assert not found.status.any()
    for j in range(3):
        gradient = a.conj().T @ (b[:, j] - a @ found.x[:, j])
        gradient /= np.abs(gradient).max()
        on = np.abs(found.x[:, j]) > 1e-3 * np.abs(found.x[:, j]).max()
        np.testing.assert_allclose(gradient[on], found.x[on, j] / np.abs(found.x[on, j]), atol=5e-3)
        assert found.residual[j] == pytest.approx(delta[j], rel=1e-3)


def test_sparse_vectors_are_found():
    a, b, delta, x = problem(2, noise=1e-4)
    found = basis_pursuit_denoise(a, b, delta)
    assert np.linalg.norm(found.x - x) < 1e-3 * np.linalg.norm(x)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), power=st.integers(-9, 9), other=st.integers(-9, 9))
def test_results_scale_with_matrix_and_data(seed, power, other):
    a, b, delta, _ = problem(seed, m=12, n=25)
    one = basis_pursuit_denoise(a, b, delta)
    scaled = basis_pursuit_denoise(a * 10.0**power, b * 10.0**other, delta * 10.0**other)
    np.testing.assert_array_equal(scaled.status, one.status)
    np.testing.assert_allclose(scaled.x * 10.0 ** (power - other), one.x, atol=1e-7 * np.abs(one.x).max())


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), kind=st.sampled_from(["random", "grouped", "scaled", "decaying"]))
def test_the_certificate_is_true_or_the_status_says_not(seed, kind):
    rng = np.random.default_rng(seed)
    a, b, delta, x = problem(seed, int(rng.integers(4, 40)), int(rng.integers(5, 90)), 2, 3, kind=kind)
    found = basis_pursuit_denoise(a, b, delta, iterations=400)
    residual = np.linalg.norm(a @ found.x - b, axis=0)
    np.testing.assert_allclose(found.residual, residual, rtol=1e-9)
    within = residual <= (1 + 1e-3) * delta + 1e-12 * np.linalg.norm(b, axis=0)
    np.testing.assert_array_equal((found.status & DenoiseStatus.INFEASIBLE) == 0, within)
    done = (found.status & DenoiseStatus.NOT_CONVERGED) == 0
    # the truth is within the residual, so that its norm bounds the least one
    norm, true = np.abs(found.x).sum(0), np.abs(x).sum(0)
    assert np.all(norm[done] <= (1 + 2e-3) * true[done])


def test_right_hand_sides_do_not_depend_on_each_other():
    a, b, delta, _ = problem(3, k=5)
    whole = basis_pursuit_denoise(a, b, delta)
    for j in range(5):
        alone = basis_pursuit_denoise(a, b[:, [j]], delta[[j]])
        np.testing.assert_allclose(alone.x[:, 0], whole.x[:, j], atol=1e-9)


def test_what_needs_no_solving_is_exact():
    a, b, _, _ = problem(4)
    size = np.linalg.norm(b, axis=0)
    found = basis_pursuit_denoise(a, b, 1.0001 * size)
    assert not found.x.any()
    assert not found.status.any()
    nothing = basis_pursuit_denoise(a, 0 * b, 0.0)
    assert not nothing.x.any()
    assert not nothing.status.any()
    dark = basis_pursuit_denoise(0 * a, b, 0.5 * size)
    assert np.all(dark.status & DenoiseStatus.INFEASIBLE)


def test_data_out_of_reach_are_flagged_and_answered_by_least_squares():
    rng = np.random.default_rng(5)
    a, b = cn(rng, 30, 8), cn(rng, 30, 2)
    least = np.linalg.lstsq(a, b, rcond=None)[0]
    smallest = np.linalg.norm(a @ least - b, axis=0)
    found = basis_pursuit_denoise(a, b, 0.5 * smallest)
    assert np.all(found.status & DenoiseStatus.INFEASIBLE)
    np.testing.assert_allclose(found.x, least, atol=1e-6)
    enough = basis_pursuit_denoise(a, b, 1.01 * smallest)
    assert not enough.status.any()


def test_weights_and_a_start():
    a, b, delta, _ = problem(6)
    weights = np.random.default_rng(0).uniform(0.5, 2, 80)
    found = basis_pursuit_denoise(a, b, delta, weights=weights, tolerance=1e-5, iterations=20_000)
    # the same problem with the weights in the columns
    other = basis_pursuit_denoise(a / weights, b, delta, tolerance=1e-5, iterations=20_000).x / weights[:, None]
    norms = [(weights[:, None] * np.abs(x)).sum(0) for x in (found.x, other)]
    np.testing.assert_allclose(*norms, rtol=1e-3)
    warm = basis_pursuit_denoise(a, b, delta, weights=weights, start=found.x)
    cold = basis_pursuit_denoise(a, b, delta, weights=weights)
    assert warm.iterations < 0.5 * cold.iterations
    np.testing.assert_allclose((weights[:, None] * np.abs(warm.x)).sum(0), norms[0], rtol=2e-3)


def test_every_right_hand_side_may_have_its_own_weights():
    a, b, delta, _ = problem(6)
    weights = np.random.default_rng(1).uniform(0.2, 2, (80, b.shape[1]))
    found = basis_pursuit_denoise(a, b, delta, weights=weights, tolerance=1e-6, iterations=20_000)
    balls = np.broadcast_to(delta, b.shape[1])
    for k, ball in enumerate(balls):
        alone = basis_pursuit_denoise(a, b[:, [k]], ball, weights=weights[:, k], tolerance=1e-6, iterations=20_000)
        np.testing.assert_allclose(found.x[:, k], alone.x[:, 0], atol=1e-3 * np.abs(alone.x).max())
    with pytest.raises(ValueError, match="weights must have shape"):
        basis_pursuit_denoise(a, b, delta, weights=weights[:, :-1])


def test_single_precision_stays_single_and_within_the_residual():
    a, b, delta, _ = problem(7)
    found = basis_pursuit_denoise(a.astype(np.complex64), b.astype(np.complex64), delta)
    assert found.x.dtype == np.complex64
    assert not found.status.any()


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"matrix": np.ones(3)}, "matrix must have shape"),
        ({"rhs": np.ones((4, 2))}, "rhs must have shape"),
        ({"rhs": np.full((5, 2), np.nan)}, "rhs must be finite"),
        ({"delta": [1.0, 2.0, 3.0]}, "delta must have shape"),
        ({"delta": -1.0}, "delta must be >= 0"),
        ({"weights": np.zeros(7)}, "weights must be > 0"),
        ({"start": np.ones((7, 3))}, "start must have shape"),
        ({"tolerance": 0.0}, "tolerance must be > 0"),
        ({"iterations": 0}, "iterations must be >= 1"),
    ],
)
def test_wrong_arguments_are_named(change, text):
    arguments = {"matrix": np.ones((5, 7)), "rhs": np.ones((5, 2)), "delta": 0.1} | change
    with pytest.raises(ValueError, match=text):
        basis_pursuit_denoise(**arguments)
