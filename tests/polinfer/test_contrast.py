"""Contrast is what it is defined as, and its intervals hold the truth as often as they say."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm, vonmises

from polinfer import contrast

RNG = np.random.default_rng


def two_regions(count, difference, rng, scale=(1.0, 1.0)):
    """Independent normal values of two regions, and their labels."""
    labels = np.repeat([0, 1], count)
    return RNG(rng).normal(difference * labels, np.where(labels, scale[1], scale[0])), labels


def samples_of(first, second, difference, spread, rng, pixels=40, own=0.3):
    """Values, labels, sample numbers: samples differ by normal deviates of both regions and of each alone."""
    generator = RNG(rng)
    number = np.concatenate([np.repeat(np.arange(n), pixels) for n in (first, second)])
    labels = np.repeat([0, 1], [first * pixels, second * pixels])
    common, alone = generator.normal(0, spread, max(first, second)), generator.normal(0, own, (2, max(first, second)))
    values = difference * labels + common[number] + alone[labels, number] + generator.normal(size=labels.size)
    return values, labels, number


def test_cnr_is_its_definition():
    values, labels = two_regions(300, 1.5, 1, (1.0, 2.0))
    a, b = values[labels == 0], values[labels == 1]
    found = contrast.cnr(values, labels, rng=1)
    assert found.value == pytest.approx(abs(a.mean() - b.mean()) / np.hypot(a.std(), b.std()), rel=1e-12)
    assert contrast.cnr(values, labels, regions=(1, 0), rng=1).value == pytest.approx(found.value, rel=1e-12)
    assert found.low < found.value < found.high
    assert "sqrt" in found.definition


def test_circular_cnr_equals_the_linear_one_far_from_the_wrap_and_does_not_see_the_wrap():
    values, labels = two_regions(20000, 0.5, 2, (0.2, 0.3))
    linear = contrast.cnr(values, labels, rng=1).value
    around = contrast.cnr(values, labels, period=2 * np.pi, rng=1)
    assert around.value == pytest.approx(linear, rel=0.01)
    for shift in (2.9, -7.0):
        turned = np.angle(np.exp(1j * (values + shift)))
        other = contrast.cnr(turned, labels, period=2 * np.pi, rng=1)
        np.testing.assert_allclose(
            [other.value, other.low, other.high], [around.value, around.low, around.high], rtol=1e-9
        )
    axes = contrast.cnr(values / 2, labels, period=np.pi, rng=1)
    assert axes.value == pytest.approx(around.value, rel=1e-9)


def test_circular_cnr_is_the_resultants():
    generator = RNG(3)
    a, b = generator.vonmises(0.0, 2.0, 400), generator.vonmises(2.5, 1.0, 300)
    found = contrast.cnr(np.concatenate([a, b]), np.repeat([0, 1], [400, 300]), period=2 * np.pi, rng=1)
    first, second = np.exp(1j * a).mean(), np.exp(1j * b).mean()
    noise = np.sqrt(-2 * np.log(abs(first)) - 2 * np.log(abs(second)))
    assert found.value == pytest.approx(abs(np.angle(second / first)) / noise, rel=1e-12)


def test_opposite_directions_have_an_interval_below_half_a_turn():
    generator = RNG(4)
    labels = np.repeat([0, 1], 60)
    angles = np.angle(np.exp(1j * (np.pi * labels + generator.normal(0, 0.4, 120))))
    found = contrast.cnr(angles, labels, period=2 * np.pi, rng=1)
    spread = np.sqrt(sum(-2 * np.log(abs(np.exp(1j * angles[labels == r]).mean())) for r in (0, 1)))
    assert found.low < np.pi / spread
    assert found.value <= np.pi / spread <= found.high * 1.2


def overlap(first, second, low, high):
    return 1 - quad(lambda x: min(first(x), second(x)), low, high, limit=400)[0]


@pytest.mark.parametrize(
    ("draw", "truth"),
    [
        (lambda g, n: (g.normal(0, 1, n), g.normal(1, 1, n)), overlap(norm.pdf, norm(1).pdf, -8, 9)),
        # the same mean: CNR sees nothing
        (lambda g, n: (g.normal(0, 1, n), g.normal(0, 3, n)), overlap(norm.pdf, norm(0, 3).pdf, -20, 20)),
        (lambda g, n: (g.normal(0, 1, n), g.normal(0, 1, n)), 0.0),
        (lambda g, n: (g.exponential(1, n), g.exponential(8, n)),
         overlap(lambda x: np.exp(-x), lambda x: np.exp(-x / 8) / 8, 0, 100)),
    ],
)  # fmt: skip
def test_gcnr_is_one_less_the_overlap_and_does_not_change_if_values_are_stretched(draw, truth):
    a, b = draw(RNG(5), 6000)
    values, labels = np.concatenate([a, b]), np.repeat([0, 1], 6000)
    found = contrast.gcnr(values, labels, rng=1)
    # three standard errors of a difference of two shares, and half a bin
    assert abs(found.value - truth) < 3 * np.sqrt(0.5 / 6000) + 0.5 / 32
    assert found.low <= truth <= found.high
    stretched = contrast.gcnr(np.arcsinh(7 * values), labels, rng=1)
    assert (stretched.value, stretched.low, stretched.high) == (found.value, found.low, found.high)


def test_circular_gcnr_is_the_overlap_on_the_circle_wherever_it_is_cut():
    generator = RNG(6)
    a, b = generator.vonmises(3.0, 4.0, 8000), generator.vonmises(-2.6, 2.0, 8000)
    truth = overlap(lambda x: vonmises.pdf(x, 4.0, loc=3.0), lambda x: vonmises.pdf(x, 2.0, loc=-2.6), -np.pi, np.pi)
    labels = np.repeat([0, 1], 8000)
    values = np.concatenate([a, b])
    for shift in (0.0, 1.0, 2.0):
        found = contrast.gcnr(values + shift, labels, period=2 * np.pi, rng=1)
        assert abs(found.value - truth) < 3 * np.sqrt(0.5 / 8000) + 0.5 / 32


def test_separate_regions_have_a_gcnr_of_one_and_an_interval_that_depends_on_how_many_there_are():
    def apart(count):
        labels = np.repeat([0, 1], count)
        return RNG(7).uniform(0, 1, 2 * count) + 2 * labels, labels

    few, many = (contrast.gcnr(*apart(n), rng=1) for n in (20, 2000))
    assert few.value == many.value == few.high == many.high == 1
    assert few.low < 0.9 < 0.99 < many.low
    # no error among 20 and 20 decisions, had they erred as often as this, has a chance of 2.5 % at most
    assert (1 - (1 - few.low) / 2) ** 40 < 0.025
    assert (few.low + 0.1) ** 20 > 0.025
    number, labels = np.tile(np.repeat(np.arange(10), 200), 2), np.repeat([0, 1], 2000)
    alike = 2 * labels + RNG(8).uniform(0, 1, 10)[number] + 1e-3 * RNG(9).normal(size=4000)
    as_samples = contrast.gcnr(alike, labels, samples=number, rng=1)  # worth 10 and 10 pixels
    assert 0.9 < as_samples.value <= as_samples.high == 1
    assert as_samples.low < 0.65


def coverage(measure, truth, make, runs):
    held = 0
    for k in range(runs):
        values, labels, number = make(k)
        found = measure(values, labels, samples=number, resamples=300, rng=k)
        held += found.low <= truth <= found.high
    return held / runs


@pytest.mark.parametrize(
    ("difference", "units", "runs"),
    [
        (0.0, (9, 6), 150),
        (2.0, None, 60),
        pytest.param(2.0, (9, 6), 150, marks=pytest.mark.slow),
        pytest.param(0.0, None, 60, marks=pytest.mark.slow),
    ],
)
def test_intervals_hold_the_truth_as_often_as_they_say(difference, units, runs):
    def make(k):
        if units is None:
            return *two_regions(300, difference, k), None
        return samples_of(*units, difference, 0.5, k)

    width = 1.0 if units is None else np.sqrt(1 + 0.5**2 + 0.3**2)
    truths = {contrast.cnr: difference / width / 2**0.5, contrast.gcnr: 2 * norm.cdf(difference / width / 2) - 1}
    for measure, truth in truths.items():
        # three standard errors of a share of 95 %
        assert coverage(measure, truth, make, runs) > 0.95 - 3 * np.sqrt(0.95 * 0.05 / runs)


def test_pixels_of_samples_that_are_alike_say_less_than_as_many_independent_ones():
    values, labels, number = samples_of(8, 8, 4.0, 1.0, 8, own=1.0)
    naive, honest = (contrast.cnr(values, labels, samples=s, rng=1) for s in (None, number))
    assert honest.high - honest.low > 2 * (naive.high - naive.low)
    assert naive.value == pytest.approx(honest.value, rel=1e-12)
    assert (naive.units, honest.units) == ((30, 30), (8, 8))


def test_tiles_are_squares_that_no_two_frames_share():
    number = contrast.tiles((2, 5, 7), 3)
    assert number.shape == (2, 5, 7)
    assert len(np.unique(number)) == 2 * 2 * 3
    for k in np.unique(number):
        frame, y, x = np.nonzero(number == k)
        assert len(set(frame)) == 1
        assert max(np.ptp(y), np.ptp(x)) < 3


def test_what_has_no_answer_is_left_out_counted_or_nan():
    values, labels = two_regions(50, 1.0, 9)
    values[3], values[60] = np.nan, np.nan
    mask = np.ones(100, bool)
    mask[:3] = False
    found = contrast.cnr(values, labels, mask=mask, rng=1)
    assert (found.pixels, found.left_out) == ((46, 49), 2)
    kept = mask & ~np.isnan(values)
    assert found.value == contrast.cnr(values[kept], labels[kept], rng=1).value
    for measure in (contrast.cnr, contrast.gcnr):
        lonely = measure(values, labels, samples=labels, rng=1)  # each region in a single sample
        assert np.isfinite(lonely.value)
        assert np.isnan([lonely.low, lonely.high]).all()
        tiny = measure([1.0, 2.0], [0, 1], rng=1)
        assert np.isnan([tiny.low, tiny.high]).all()
    flat = contrast.cnr(np.ones(20), np.repeat([0, 1], 10), rng=1)
    assert np.isnan([flat.value, flat.low, flat.high]).all()


def test_a_seed_gives_the_same_interval_and_is_recorded():
    values, labels, number = samples_of(6, 6, 1.0, 0.5, 10)
    for measure in (contrast.cnr, contrast.gcnr):
        fresh = measure(values, labels, samples=number)
        assert measure(values, labels, samples=number, rng=fresh.seed) == fresh
        single = measure(values.astype(np.float32), labels, samples=number, rng=fresh.seed)
        assert single.value == pytest.approx(fresh.value, abs=1e-5)
        wider = measure(values, labels, samples=number, level=0.99, rng=fresh.seed)
        assert wider.low <= fresh.low <= fresh.high <= wider.high


@pytest.mark.parametrize(
    ("error", "message", "change"),
    [
        (ValueError, "labels has no pixel of region 5", {"regions": (0, 5)}),
        (ValueError, "two different labels", {"regions": (1, 1)}),
        (ValueError, "samples has pixel shape", {"samples": np.zeros(3, int)}),
        (TypeError, "labels must be integers", {"labels": np.zeros(20)}),
        (TypeError, "mask must be a bool", {"mask": np.ones(20)}),
        (ValueError, "values must be finite or NaN", {"values": np.full(20, np.inf)}),
        (ValueError, "period must be > 0", {"period": 0.0}),
        (ValueError, "level must be <= 1", {"level": 95.0}),
        (ValueError, "resamples must be >= 100", {"resamples": 10}),
    ],
)
def test_what_cannot_be_is_refused_with_its_name(error, message, change):
    arguments = {"values": np.arange(20.0), "labels": np.repeat([0, 1], 10)} | change
    for measure in (contrast.cnr, contrast.gcnr):
        with pytest.raises(error, match=message):
            measure(**arguments, rng=1)
