"""The multiplied-out elements are the matrix products."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import polinfer
from polinfer.elements import polariser, retarder
from polinfer.orderings import PolariserFirst, RetarderFirst, on_host
from polinfer.orderings.on_host import jones_on_host
from tests.oracles import jones as oracle

ANGLE = st.floats(-7, 7)
EDGES = [(d, td, eta, te, xi) for d in (-1.0, 0.0, 1.0) for td in (0.0, np.pi / 2) for eta in (0.0, np.pi)
         for te in (0.0, np.pi / 4) for xi in (0.0, np.pi)]  # fmt: skip


@settings(max_examples=50, deadline=None)
@given(st.floats(-1, 1), ANGLE, ANGLE, ANGLE, ANGLE)
def test_elements_and_orderings_are_the_products(d, td, eta, te, xi):
    np.testing.assert_allclose(polariser(d, td), oracle.polariser(d, td), atol=1e-13)
    np.testing.assert_allclose(retarder(eta, te, xi), oracle.retarder(eta, te, xi), atol=1e-13)
    p = polinfer.Parameters(d, td, eta, te, xi)
    np.testing.assert_allclose(RetarderFirst().jones(p), oracle.jones(p), atol=1e-13)
    np.testing.assert_allclose(PolariserFirst().jones(p), oracle.jones(p, "polariser_first"), atol=1e-13)


def test_pixels_broadcast():
    p = polinfer.Parameters(0.1, np.zeros(3), np.ones((2, 1)), 0.3, 0.0)
    matrices = RetarderFirst().jones(p)
    assert matrices.shape == (2, 3, 2, 2)
    np.testing.assert_allclose(matrices[1, 2], oracle.jones((0.1, 0, 1, 0.3, 0)), atol=1e-14)


@pytest.mark.parametrize("shape", [(), (0,), (5,), (3, 4), (300,)])
def test_arrays_of_any_shape_are_computed_in_rows_of_few_lengths(shape):
    values = np.random.default_rng(1).uniform(-1, 1, (5, *shape))
    values[1] = 0.3
    found = jones_on_host(PolariserFirst(), polinfer.Parameters(values[0], 0.3, *values[2:]))
    expected = [oracle.jones(x, "polariser_first") for x in values.reshape(5, -1).T]
    np.testing.assert_allclose(found, np.reshape(expected, (*shape, 2, 2)), atol=1e-14)
    compiled = on_host._compiled._cache_size()
    jones_on_host(PolariserFirst(), polinfer.Parameters(*values.reshape(5, -1)[:, 1:]))
    assert on_host._compiled._cache_size() == compiled
    single = jones_on_host(PolariserFirst(), polinfer.Parameters(*values.astype(np.float32)))
    assert single.dtype == np.complex64


def test_diattenuation_beyond_one_is_nan():
    assert np.isnan(polariser(1.01, 0.0)).all()


@pytest.mark.parametrize("ordering", [RetarderFirst(), PolariserFirst()])
def test_closed_form_inverts_the_products_up_to_a_complex_factor(ordering):
    generator = np.random.default_rng(1)
    cases = np.concatenate([generator.uniform(-1, 1, (200, 5)) * [1, 1.5, 3, 1.5, 3], EDGES])
    truth = polinfer.Parameters(*cases.T)
    matrices = np.asarray(ordering.jones(truth))
    factor = generator.normal(size=len(cases)) + 1j * generator.normal(size=len(cases))
    found = polinfer.decompose(factor[:, None, None] * matrices, ordering)
    again = np.asarray(ordering.jones(found))
    overlap = np.abs(np.sum(np.conj(again) * matrices, axis=(-1, -2)))
    np.testing.assert_allclose(overlap, 2.0, atol=1e-12)  # both have norm sqrt 2: equal up to a phase
    regular = np.abs(np.abs(truth.diattenuation) - 1) > 1e-9
    expected = polinfer.canonicalise(truth)
    np.testing.assert_allclose(found.diattenuation[regular], expected.diattenuation[regular], atol=1e-9)


def test_closed_form_says_nan_for_what_is_no_matrix():
    matrices = np.stack([np.zeros((2, 2)), np.full((2, 2), np.nan), np.eye(2)])
    assert np.isnan(polinfer.decompose(matrices, RetarderFirst()).retardance).tolist() == [True, True, False]


def test_ordering_error_is_the_mean_relative_difference_of_the_elements():
    x = (0.2, 0.4, 1.1, 0.6, 0.3)
    forward, reverse = oracle.jones(x), oracle.jones(x, "polariser_first")
    q, frobenius = polinfer.ordering_error(polinfer.Parameters(*x))
    assert q == pytest.approx(np.mean(abs(forward - reverse) / abs(forward)), rel=1e-12)
    assert frobenius == pytest.approx(np.linalg.norm(forward - reverse) / np.linalg.norm(forward), rel=1e-12)


def test_ordering_error_reproduces_the_distribution_known_for_the_products():
    generator = np.random.default_rng(0)
    angles = generator.uniform(-1, 1, (4, 100_000)) * np.array([np.pi / 2, np.pi, np.pi / 2, np.pi])[:, None]
    q, _ = polinfer.ordering_error(polinfer.Parameters(generator.normal(0, 0.01, 100_000), *angles))
    assert np.mean(q < 0.05) == pytest.approx(0.967, abs=0.003)
