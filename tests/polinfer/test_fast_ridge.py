"""Ridges are followed to their maximum, and single precision hands on what it cannot settle."""

import jax
import numpy as np
import pytest

from polinfer import ComplexGain, Measurement, Model, Parameters, PhaseGain, PolariserFirst, RetarderFirst, Status, fit
from polinfer.fitting.fast import ridge
from polinfer.fitting.fast.engine import pairs_of
from polinfer.fitting.fast.scene import scene
from polinfer.precision import double_precision, is_double
from polinfer.threads import each
from tests.oracles import jones as oracle
from tests.polinfer.scenes import BALANCED

ORDERINGS = (RetarderFirst(), PolariserFirst())
GAINS = (None, PhaseGain(), ComplexGain(1.0))


def place_of(known, parameters, illumination, response):
    start = ridge._place(known, pairs_of(parameters, np.float64))
    return ridge._with_gain(known, illumination, response, start)


@pytest.mark.parametrize("ordering", ORDERINGS, ids=["retarder_first", "polariser_first"])
@pytest.mark.parametrize("gain", GAINS, ids=["unit", "phase", "complex"])
def test_gradient_and_curvature_along_rotations_are_finite_differences_of_the_density(ordering, gain):
    rng, n, step = np.random.default_rng(1), 4, 1e-4
    known = scene(Model(ordering, gain=gain))
    illumination, response = rng.normal(size=(2, n, 2, 2)) + 1j * rng.normal(size=(2, n, 2, 2))
    truth = Parameters(*(rng.uniform(low, high, n) for low, high in
                         ((-0.9, 0.9), (-1, 1), (0.3, 2.5), (0.2, 1.3), (-1.2, 1.2))))  # fmt: skip
    place = place_of(known, truth, illumination, response)
    here = ridge._system(known, illumination, response, place)

    def value(move):
        other = ridge._moved(known, place, np.tile(step * np.asarray(move), (n, 1)))
        other = ridge._with_gain(known, illumination, response, other)
        return ridge._system(known, illumination, response, other).value

    unit = np.eye(here.slope.shape[1])[:5]
    slope = here.slope - 2 * np.einsum("pri,pr->pi", here.first, here.residual)
    curvature = here.bend - 2 * here.second - 2 * np.einsum("pri,prj->pij", here.first, here.first)
    if gain is not None:  # the best gain follows
        cross, own = curvature[:, :5, 5:], curvature[:, 5:, 5:]
        curvature = curvature[:, :5, :5] - cross @ np.linalg.solve(own, np.swapaxes(cross, 1, 2))
    for i in range(5):
        np.testing.assert_allclose(slope[:, i], (value(unit[i]) - value(-unit[i])) / (2 * step), atol=1e-5)
        for j in range(5):
            corners = [a * b * value(a * unit[i] + b * unit[j]) for a in (1, -1) for b in (1, -1)]
            np.testing.assert_allclose(curvature[:, i, j], np.sum(corners, axis=0) / (4 * step**2), atol=2e-4)


@pytest.mark.parametrize("ordering", ORDERINGS, ids=["retarder_first", "polariser_first"])
def test_behind_a_perfect_polariser_all_ways_along_the_ridge_end_no_lower_than_the_truth(ordering):
    known, n = scene(Model(ordering, gain=ComplexGain(1.0))), 12
    for sigma in (1e-3, 1e-8):
        truth, response = polarised(ordering, n, sigma, 2)
        root = np.broadcast_to(1.5**0.5 * np.eye(2) / sigma, (n, 2, 2))
        y = response @ BALANCED.conj().T / 1.5**0.5 / sigma
        start = pairs_of(truth, np.float64)
        at_truth = ridge._system(known, root, y, place_of(known, truth, root, y)).value
        tops = []
        for alpha in (0.0, 0.3, -0.3):
            begun = ridge.turned(known, start, alpha, np.full(n, 1 / sigma))
            _, value, arrived = ridge.follow(known, root, y, begun)
            assert arrived.mean() > 0.8
            tops.append(np.where(arrived, value, -np.inf))
        assert (np.max(tops, axis=0) > at_truth).all()


def polarised(ordering, n, sigma, seed):
    """Parameters with D = 1, and data of the matrix products in plain NumPy."""
    rng = np.random.default_rng(seed)
    truth = Parameters(np.ones(n), *(rng.uniform(0.2, 1.3, (4, n))))
    names = "retarder_first" if isinstance(ordering, RetarderFirst) else "polariser_first"
    matrices = np.stack([oracle.jones([x[i] for x in truth], names) for i in range(n)])
    noise = rng.normal(size=(2, n, 2, 3))
    return truth, matrices @ BALANCED + sigma / 2**0.5 * (noise[0] + 1j * noise[1])


@pytest.mark.slow  # two precisions to compile
def test_single_precision_is_no_worse_than_double_behind_a_perfect_polariser_at_a_signal_of_100000():
    model = Model(gain=ComplexGain(1.0))
    _, response = polarised(model.ordering, 24, 1e-5, 3)
    rounded = response.astype(np.complex64)
    states = BALANCED.astype(np.complex64)
    double = fit(model, Measurement(states.astype(complex), rounded.astype(complex), 1e-5))
    single = fit(model, Measurement(states, rounded, 1e-5))
    assert single.log_posterior.dtype == np.float32
    assert not np.any((double.status | single.status) & int(Status.NOT_CONVERGED))
    np.testing.assert_allclose(single.log_posterior, double.log_posterior, atol=1e-2)
    for name in Parameters._fields[1:]:
        ours, theirs = getattr(single.parameters, name), getattr(double.parameters, name)
        np.testing.assert_allclose(np.cos(2 * ours), np.cos(2 * theirs), atol=1e-3, err_msg=name)


def test_double_precision_is_that_of_a_block_and_of_the_threads_that_it_starts():
    before, seen = is_double(), []
    for wanted in (True, False):
        with double_precision(wanted):
            each(lambda _: seen.append(is_double()), range(4))
            assert is_double() == wanted
            assert jax.numpy.zeros(1).dtype == (np.float64 if wanted else np.float32)
        assert is_double() == before
    assert seen == [True] * 4 + [False] * 4
