"""A verdict needs a probability and a lead that stands out of its scatter; every datum is pooled once."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from polinfer import Model, Window
from polinfer.comparison.judgement import judge, probabilities
from polinfer.comparison.units import tiles, units_of
from polinfer.neighbours import box_sum

EVEN = np.log([0.5, 0.5])


def scenes(differences):
    """Log evidences (2, scenes, units) whose difference is given."""
    d = np.atleast_2d(np.asarray(differences, float))
    return np.stack([d - 3.0, np.zeros_like(d) - 3.0]), np.ones(d.shape, bool)


def test_probabilities_are_prior_times_evidence_over_their_sum():
    evidence, prior = np.array([-1000.0, -1001.0, -1003.0]), np.array([0.2, 0.3, 0.5])
    weight = prior * np.exp(evidence + 1000)
    np.testing.assert_allclose(probabilities(evidence, np.log(prior)), weight / weight.sum(), rtol=1e-12)


def test_scatter_is_the_standard_deviation_of_a_sum_by_the_spread_of_its_terms():
    terms = np.random.default_rng(1).normal(0.4, 1.0, (5, 40))
    found = judge(*scenes(terms), EVEN)
    np.testing.assert_allclose(found.pooled[0] - found.pooled[1], terms.sum(axis=1))
    lost = np.argmin(found.probability, axis=0)
    np.testing.assert_allclose(found.scatter[lost, np.arange(5)], terms.std(axis=1, ddof=1) * 40**0.5)
    assert np.all(found.scatter[1 - lost, np.arange(5)] == 0)


def test_terms_without_a_mean_rarely_make_a_verdict_though_bayes_factors_would():
    """972 symmetric terms of half a nat: products of Bayes factors decide most scenes, the verdict one in twenty."""
    terms = np.random.default_rng(2).normal(0, 0.5, (2000, 972))
    found = judge(*scenes(terms), EVEN)
    assert np.mean(found.probability.max(axis=0) > 0.95) > 0.8
    share = np.mean(found.choice >= 0)
    assert abs(share - 0.05) < 4 * np.sqrt(0.05 * 0.95 / 2000)


def test_a_calibrated_lead_is_found():
    """Terms of variance twice their mean, as a right model makes them: expected sum 20 nats."""
    terms = np.random.default_rng(3).normal(0.02, 0.2, (2000, 1000))
    found = judge(*scenes(terms), EVEN)
    assert np.mean(found.choice == 0) > 0.85
    assert np.mean(found.choice == 1) < 1e-3


@pytest.mark.parametrize(("terms", "choice"), [
    ([2.0], -1), ([3.0], 0), ([-3.0], 1),  # one unit: the probability alone, 0.95 at log 19
    ([0.0, 0.0, 0.0], -1),  # the same model twice
    ([1.0, 1.0, 1.0], 0), ([9.0, -2.0, -1.0], -1),
])  # fmt: skip
def test_few_units(terms, choice):
    assert judge(*scenes(terms), EVEN).choice.tolist() == [choice]


def test_units_that_are_not_used_change_nothing():
    values, used = scenes([1.0, 1.2, 0.9, 500.0])
    used[0, 3] = False
    values[:, 0, 3] = np.nan
    found, fewer = judge(values, used, EVEN), judge(*scenes([1.0, 1.2, 0.9]), EVEN)
    for a, b in zip(found, fewer, strict=True):
        np.testing.assert_allclose(a, b)
    nothing = judge(values, np.zeros_like(used), EVEN)
    assert nothing.choice.tolist() == [-1]
    assert np.isnan(nothing.probability).all()


sizes = st.integers(1, 12)
widths = st.integers(0, 3).map(lambda n: 2 * n + 1)


@settings(max_examples=60, deadline=None)
@given(st.tuples(sizes, sizes), widths, widths, st.integers(1, 2))
def test_tiles_are_disjoint_windows_that_cover_the_frame(shape, rows, columns, frames):
    window = Window(rows, columns)
    label, centre = tiles((frames, *shape), window)
    # pixels of the window around each centre, by adding a 1 there
    marked = np.zeros((len(centre), frames, *shape))
    marked.reshape(len(centre), -1)[np.arange(len(centre)), centre] = 1
    held = np.array([box_sum(m, window) for m in marked]) > 0.5
    assert np.all(held.sum(axis=0) == 1)
    np.testing.assert_array_equal(np.argmax(held, axis=0), label)


@pytest.mark.parametrize("shape", [(7, 11), (2, 6, 5), (9,)])
def test_windows_and_pixels_by_themselves_are_pooled_over_the_same_data(shape):
    """Log evidences that add up like those of data: the sums over tiles and over pixels agree."""
    each = np.random.default_rng(4).normal(size=shape)
    window = Window(3, 5)
    status = np.zeros((2, *shape), int)
    dark = np.random.default_rng(5).random(shape) < 0.1
    status[:, dark] = 1
    shared = box_sum(np.where(dark, 0, each), window)
    evidence = np.stack([np.where(dark, np.nan, each), np.where(dark, np.nan, shared)])
    found = units_of([Model(), Model(neighbours=window)], evidence, np.full(evidence.shape, 0.1), status)
    assert found.used.sum() == np.sum(~dark.ravel()[found.centre])
    np.testing.assert_allclose(found.values[0], found.values[1])
    members = np.bincount(found.label.ravel(), ~dark.ravel())
    np.testing.assert_allclose(found.errors[0], 0.1 * np.sqrt(members))
    np.testing.assert_allclose(found.errors[1], 0.1)


def test_a_tile_counts_only_where_all_its_pixels_have_an_answer():
    evidence = np.zeros((2, 1, 9))
    status = np.zeros((2, 1, 9), int)
    status[0, 0, 1] = 4  # not converged, beside a centre, in the model without a window
    status[1, 0, 5] = 4  # the same in the other one: only its centres matter
    found = units_of([Model(), Model(neighbours=Window(1, 3))], evidence, evidence, status)
    assert found.used.tolist() == [False, True, True]
    with pytest.raises(ValueError, match="one window at a time"):
        units_of([Model(neighbours=Window(1, 3)), Model(neighbours=Window(3, 3))], evidence, evidence, status)
