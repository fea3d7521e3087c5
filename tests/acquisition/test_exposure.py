"""Merging a bracket is unbiased, its variance is true, and it wastes almost no light."""

import numpy as np
import pytest

from acquisition import Bracket, InverseVariance, LongestUnsaturated, merge_exposures
from acquisition.merging import merge_views

GAIN, READ, DARK, FULL = 2.0, 3.0, 20.0, 4095
TIMES = 0.1 / 2.0 ** np.arange(9)
# five decades; none so dark that the cut at zero counts is felt, none whose noise straddles saturation
RADIANCE = np.array([200.0, 1e3, 3e3, 3e4, 1.1e5, 2.2e5, 4.5e5, 1.8e6, 1.4e7, 2.0e7])
RULES = [InverseVariance(GAIN, READ, DARK), LongestUnsaturated(GAIN, READ, DARK)]
COUNT = 16000


def frames(radiance, rng):
    """Counts of a camera with shot noise of signal and dark current, read noise, rounding and saturation."""
    generator = np.random.default_rng(rng)
    mean = (radiance + DARK) * TIMES[:, None, None]
    electrons = generator.poisson(mean) + READ * generator.normal(size=mean.shape)
    return np.clip(np.rint(electrons / GAIN), 0, FULL).astype(np.uint16)


def merged(rule, radiance=RADIANCE, rng=0):
    scene = np.repeat(radiance[:, None], COUNT, axis=1)
    found = merge_exposures(frames(scene, rng), TIMES, FULL, rule)
    return found.radiance - scene, found


def cramer_rao():
    """Least variance that any unbiased estimator can have: the information of the unsaturated exposures adds up."""
    electrons = (RADIANCE + DARK) * TIMES[:, None]
    information = TIMES[:, None] ** 2 / (electrons + READ**2 + GAIN**2 / 12)
    return 1 / np.sum(information * (electrons / GAIN < FULL), axis=0)


@pytest.mark.parametrize("rule", RULES, ids=lambda r: type(r).__name__)
def test_radiance_is_unbiased_and_its_variance_true_over_decades(rule):
    error, found = merged(rule)
    spread = error.std(1)
    assert np.all(np.abs(error.mean(1)) < 4 * spread / np.sqrt(COUNT) + 0.02 * spread)
    np.testing.assert_allclose((error**2).mean(1), found.variance.mean(1), rtol=0.1)
    assert not found.saturated.any()


def test_inverse_variance_reaches_the_cramer_rao_bound():
    error, found = merged(RULES[0])
    np.testing.assert_allclose((error**2).mean(1), cramer_rao(), rtol=0.05)
    np.testing.assert_allclose(found.variance.mean(1), cramer_rao(), rtol=0.02)


def test_inverse_variance_is_never_worse_than_the_longest_unsaturated():
    best, longest = ((merged(rule)[0] ** 2).mean(1) for rule in RULES)
    assert np.all(best < 1.07 * longest)  # sampling error of either: 2 %
    assert np.all(best[1:-2] < 0.65 * longest[1:-2])  # a bracket of factor 2 has twice the light of its longest


def test_where_noise_straddles_saturation_the_bias_is_a_fraction_of_the_noise():
    """Which exposures count is decided by the noise itself there: a bias, known and small."""
    edge = np.array([FULL * GAIN / TIMES[1] - DARK])
    for rule in RULES:
        error, found = merged(rule, edge)
        deviation = np.sqrt(found.variance.mean())
        assert abs(error.mean()) < 0.6 * deviation
        assert np.sqrt((error**2).mean()) < 1.2 * deviation


def test_saturated_everywhere_is_flagged_with_infinite_variance_and_a_lower_bound():
    counts = np.full((2, 1, 2), 100, np.uint8)
    counts[:, 0, 0] = 255
    for rule in (InverseVariance(2.0, 1.0), LongestUnsaturated(2.0, 1.0)):
        found = merge_exposures(counts, [0.2, 0.1], 255, rule)
        np.testing.assert_array_equal(found.saturated, [[True, False]])
        np.testing.assert_array_equal(np.isinf(found.variance), found.saturated)
        assert found.radiance[0, 0] == pytest.approx(255 * 2 / 0.1)  # what the shortest could just not hold


def test_the_longest_unsaturated_exposure_is_taken_alone():
    counts = np.array([[[255, 40, 255]], [[255, 19, 101]], [[60, 11, 50]]], np.uint8)
    found = merge_exposures(counts, [0.4, 0.2, 0.1], 255, LongestUnsaturated(2.0, 1.0, dark=10.0))
    np.testing.assert_allclose(found.radiance, [[60 * 2 / 0.1 - 10, 40 * 2 / 0.4 - 10, 101 * 2 / 0.2 - 10]])


@pytest.mark.parametrize("rule", RULES, ids=lambda r: type(r).__name__)
def test_the_order_of_exposures_does_not_matter(rule):
    counts = frames(np.repeat(RADIANCE[:, None], 5, axis=1), 1)
    found = merge_exposures(counts, TIMES, FULL, rule)
    shuffled = np.random.default_rng(0).permutation(len(TIMES))
    again = merge_exposures(counts[shuffled], TIMES[shuffled], FULL, rule)
    np.testing.assert_allclose(again.radiance, found.radiance)
    np.testing.assert_allclose(again.variance, found.variance)


def test_one_exposure_is_counts_over_time_with_the_textbook_variance():
    found = merge_exposures(np.array([[[50]]]), [0.1], 255, InverseVariance(gain=4.0, read_noise=3.0))
    assert found.radiance[0, 0] == pytest.approx(50 * 4 / 0.1)
    assert found.variance[0, 0] == pytest.approx((50 * 4 + 3**2 + 4**2 / 12) / 0.1**2)


RULE = InverseVariance(1.0, 1.0)


@pytest.mark.parametrize(
    ("frames", "exposures", "full_scale", "rule", "error", "text"),
    [
        (np.ones((2, 3, 3)), [0.2, 0.1], 255, RULE, TypeError, "frames must be raw integer counts, got float64"),
        (np.ones((3, 3), int), [0.1], 255, RULE, ValueError, r"frames must have shape \(k, y, x\)"),
        (np.ones((0, 3, 3), int), [], 255, RULE, ValueError, "frames must have shape"),
        (np.ones((2, 3, 3), int), [0.2, -0.1], 255, RULE, ValueError, "exposures must be > 0, got -0.1"),
        (np.ones((2, 3, 3), int), [0.2, np.inf], 255, RULE, ValueError, "exposures must be finite"),
        (np.ones((2, 3, 3), int), [0.2], 255, RULE, ValueError, "exposures must have shape"),
        (np.full((1, 3, 3), 256), [0.2], 255, RULE, ValueError, "counts from 0 to full_scale 255, got 256 to 256"),
        (np.full((1, 3, 3), -1), [0.2], 255, RULE, ValueError, "counts from 0 to full_scale"),
        (np.ones((1, 3, 3), int), [0.2], 255.0, RULE, TypeError, "full_scale must be an integer"),
        (np.ones((1, 3, 3), int), [0.2], 255, "best", TypeError, "rule must be MergeRule"),
    ],
)
def test_wrong_arguments_are_named(frames, exposures, full_scale, rule, error, text):
    with pytest.raises(error, match=text):
        merge_exposures(frames, exposures, full_scale, rule)


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda: InverseVariance(0.0, 1.0), "gain must be > 0"),
        (lambda: InverseVariance(1.0, -1.0), "read_noise must be >= 0"),
        (lambda: LongestUnsaturated(1.0, 1.0, -1.0), "dark must be >= 0"),
        (lambda: Bracket(longest=0.0), "longest must be > 0"),
        (lambda: Bracket(longest=0.1, factor=1.0), "factor must be > 1"),
        (lambda: Bracket(longest=0.1, stop=0.2), "stop must be <= 0.1"),
        (lambda: Bracket(longest=0.1, stop=0.0), "stop must be > 0"),
    ],
)
def test_wrong_settings_are_named(call, text):
    with pytest.raises(ValueError, match=text):
        call()


@pytest.mark.parametrize(("factor", "steps"), [(2.0, 8), (4.0, 5), (1.5, 11), (10.0, 4)])
def test_a_bracket_falls_by_its_factor_down_to_its_stop(factor, steps):
    times = np.array(list(Bracket(longest=0.1, factor=factor, stop=0.1 / factor ** (steps - 1)).times()))
    assert len(times) == steps  # the stop itself is taken, in spite of rounding
    np.testing.assert_allclose(times, 0.1 / factor ** np.arange(steps))
    assert list(Bracket(longest=0.1, stop=0.06).times()) == [0.1]


def test_views_are_merged_as_one_by_one_and_must_have_one_size():
    rule, rng = InverseVariance(gain=2.0, read_noise=1.0), np.random.default_rng(0)
    frames = [rng.integers(0, 256, (k, 600, 500), np.uint8) for k in (2, 3)]  # more than is merged at a time
    times = [[0.2, 0.1], [0.2, 0.1, 0.05]]
    both = merge_views(frames, times, 255, rule)
    for view in range(2):
        one = merge_exposures(frames[view], times[view], 255, rule)
        np.testing.assert_array_equal(both.radiance[view], one.radiance)
        np.testing.assert_array_equal(both.variance[view], one.variance)
        np.testing.assert_array_equal(both.saturated[view], one.saturated)
        parts = [merge_exposures(frames[view][:, rows], times[view], 255, rule) for rows in (slice(1), slice(1, 600))]
        np.testing.assert_allclose(one.radiance, np.concatenate([part.radiance for part in parts]), rtol=1e-6)
    with pytest.raises(ValueError, match="frames must all have one size"):
        merge_views([frames[0], frames[1][:, :-1]], times, 255, rule)
