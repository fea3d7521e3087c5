"""Eight parameter sets describe one matrix, and one of them stands for all."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from polinfer import Parameters, canonicalise, orbit
from polinfer.degeneracy import REFERENCE, distance
from tests.oracles import jones as oracle

HALF = st.floats(-np.pi / 2, np.pi / 2)
FULL = st.floats(-np.pi, np.pi)
SETS = st.tuples(st.floats(-1, 1), HALF, FULL, HALF, FULL)


@settings(max_examples=100, deadline=None)
@given(SETS, st.sampled_from(["retarder_first", "polariser_first"]))
def test_orbit_leaves_the_matrix_fixed(x, ordering):
    copies = orbit(Parameters(*x))
    for i in range(8):
        copy = [float(values[i]) for values in copies]
        np.testing.assert_allclose(oracle.jones(copy, ordering), oracle.jones(x, ordering), atol=1e-13)


@settings(max_examples=100, deadline=None)
@given(SETS)
def test_canonicalisation_is_idempotent_and_stays_in_range(x):
    once = canonicalise(Parameters(*x))
    twice = canonicalise(once)
    np.testing.assert_allclose(once, twice, atol=1e-13)
    for value, limit in zip(once, (1, np.pi / 2, np.pi, np.pi / 2, np.pi), strict=True):
        assert abs(value) <= limit


@settings(max_examples=100, deadline=None)
@given(SETS)
def test_all_copies_have_one_canonical_member_unless_two_are_equally_near(x):
    copies = orbit(Parameters(*x))
    far = np.sort(distance(copies, Parameters(*map(np.float64, REFERENCE))))
    canonical = canonicalise(copies)
    np.testing.assert_allclose(distance(canonical, Parameters(*map(np.float64, REFERENCE))), far[0], atol=1e-9)
    if far[1] - far[0] > 1e-6:
        for values, period in zip(canonical, (np.inf, np.pi, 2 * np.pi, np.pi, 2 * np.pi), strict=True):
            spread = values - values[0]
            spread = spread if np.isinf(period) else spread - period * np.round(spread / period)
            np.testing.assert_allclose(spread, 0, atol=1e-9)


def test_rows_follow_the_published_order():
    d, td, eta, te, xi = 0.3, 0.2, 0.7, 0.4, 0.5
    quarter, half = np.pi / 2, np.pi
    rows = [(te, eta, xi), (te + quarter, -eta, xi), (-te, eta, xi + half), (quarter - te, -eta, xi + half)]
    expected = [(d, td, e, t, x) for t, e, x in rows] + [(-d, td + quarter, e, t, x) for t, e, x in rows]
    got = np.stack(orbit(Parameters(d, td, eta, te, xi)), axis=-1)
    difference = got - np.array(expected)
    np.testing.assert_allclose(difference - 2 * np.pi * np.round(difference / (2 * np.pi)) * [0, 0, 0, 0, 1]
                               - np.pi * np.round(difference / np.pi) * [0, 1, 0, 1, 0], 0, atol=1e-12)  # fmt: skip


def test_another_reference_chooses_another_copy():
    p = Parameters(0.2, 0.3, 1.0, 0.4, 0.1)
    assert canonicalise(p, reference=Parameters(-1.0, 0.3 + np.pi / 2, 1.0, 0.4, 0.1)).diattenuation == -0.2


def test_nan_stays_nan_and_does_not_disturb_the_rest():
    p = Parameters(np.array([0.1, -0.1]), np.array([np.nan, 0.3]), 1.0, 0.4, 0.1)
    canonical = canonicalise(p)
    assert np.isnan(canonical.diattenuation_angle).tolist() == [True, False]
    assert np.isfinite(canonical.retardance).all()


def test_wrong_kinds_are_refused():
    with pytest.raises(TypeError, match="must be real"):
        orbit(Parameters(0.1j, 0.0, 0.0, 0.0, 0.0))
