"""Means, widths and arcs of draws are those of the circle, whatever the wrap does."""

from math import ceil, inf, pi

import numpy as np
import pytest
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st

from polinfer import Model, Parameters, PhaseGain, Status, UniformAngle, orbit
from polinfer.records import PERIODS
from polinfer.sampling.summaries import Summary, circular_mean_and_std, highest_density, summarise_draws
from tests.polinfer.sampling.made import CENTRE, around

VALUES = st.lists(st.floats(-10, 10, width=32), min_size=1, max_size=30)
CIRCLES = [name for name in Parameters._fields if getattr(PERIODS, name) != inf]


@pytest.mark.parametrize("period", [pi, 2 * pi])
@pytest.mark.parametrize("concentration", [0.1, 1.0, 30.0])
def test_mean_direction_and_circular_width_are_those_of_scipy(period, concentration):
    values = scipy.stats.vonmises.rvs(concentration, loc=3.0, size=(7, 500), random_state=1) * period / (2 * pi)
    mean, std = circular_mean_and_std(values, period)
    half = 0.5 * period
    np.testing.assert_allclose(mean, scipy.stats.circmean(values, half, -half, axis=-1), atol=1e-12)
    np.testing.assert_allclose(std, scipy.stats.circstd(values, half, -half, axis=-1), rtol=1e-10)


def test_they_are_those_of_the_von_mises_distribution():
    """Mean resultant length I_1/I_0; 400 000 draws, so the mean is known to 3 standard errors of 1/(sqrt(n) ...)."""
    from scipy.special import i0, i1

    values = scipy.stats.vonmises.rvs(2.0, loc=-3.1, size=400_000, random_state=2)
    mean, std = circular_mean_and_std(values, 2 * pi)
    length = i1(2.0) / i0(2.0)
    # the component across the mean has variance (1 - I_2/I_0)/2 = R/kappa
    assert abs(mean + 3.1) < 4 * np.sqrt(length / 2.0 / 400_000) / length
    assert std == pytest.approx(np.sqrt(-2 * np.log(length)), rel=0.01)


def test_narrow_widths_keep_their_digits_and_even_ones_stay_finite():
    offsets = np.random.default_rng(3).normal(size=1000)
    for width in (1e-4, 1e-8, 1e-12):
        mean, std = circular_mean_and_std(pi / 2 + width * offsets, pi)
        assert std == pytest.approx(width * np.std(offsets), rel=1e-3)
        assert abs(abs(mean) - pi / 2) < width
    assert np.isfinite(circular_mean_and_std(np.linspace(-pi, pi, 401)[1:], 2 * pi)[1])
    assert circular_mean_and_std([1.0, 2.0, 6.0], inf) == (3.0, pytest.approx(np.std([1.0, 2.0, 6.0])))


def shortest_arc(values, period, held):
    """Every arc that begins at a draw, by the definition: how far one must go up from there to meet ``held`` draws."""
    lengths = [sorted((x - begin) % period for x in values)[held - 1] for begin in values]
    return min(lengths)


@given(VALUES, st.sampled_from([0.05, 0.5, 0.68, 0.95]), st.sampled_from([pi, 2 * pi]))
@settings(max_examples=300, deadline=None)
def test_arcs_hold_their_share_and_none_is_shorter(values, level, period):
    low, high = highest_density(values, period, level)
    held = ceil(level * len(values) * (1 - 1e-12))
    width = (high - low) % period
    assert -period / 2 <= low <= period / 2
    assert -period / 2 <= high <= period / 2
    inside = sum((x - low) % period <= width + 1e-9 or (low - x) % period <= 1e-9 for x in values)
    assert inside >= held
    brute = shortest_arc([x % period for x in values], period, held)
    # a draw just below another one is a whole turn above it by the definition, within rounding
    assert min(abs(width - brute), period - abs(width - brute)) < 1e-9


@given(VALUES, st.sampled_from([0.05, 0.5, 0.68, 0.95]))
@settings(max_examples=200, deadline=None)
def test_intervals_on_a_line_hold_their_share_and_none_is_shorter(values, level):
    low, high = highest_density(values, inf, level)
    held = ceil(level * len(values) * (1 - 1e-12))
    assert sum(low <= x <= high for x in values) >= held
    assert high - low == min(b - a for a in values for b in values if sum(a <= x <= b for x in values) >= held)


def test_a_share_that_rounding_spoils_is_not_one_draw_more():
    assert highest_density(np.arange(100.0), inf, 0.68) == (0.0, 67.0)
    assert highest_density(np.arange(100.0), inf, 1.0) == (0.0, 99.0)
    assert highest_density(np.arange(100.0), inf, 1e-6) == (0.0, 0.0)


def test_a_rotation_of_the_circle_rotates_means_and_arcs_and_leaves_widths():
    p = around((3,), width=0.2)
    plain = summarise_draws(Model(gain=PhaseGain()), p, None, None, np.zeros(3, int), 0.9)
    for turn in (1.0, 2.0, 3.0):
        shifted = Parameters(**{name: x if name == "diattenuation" else x + turn for name, x in p._asdict().items()})
        found = summarise_draws(Model(gain=PhaseGain()), shifted, None, None, np.zeros(3, int), 0.9)
        for name in CIRCLES:
            period = getattr(PERIODS, name)
            for part in ("mean", "low", "high"):
                change = getattr(getattr(found, part), name) - getattr(getattr(plain, part), name) - turn
                np.testing.assert_allclose(change - period * np.round(change / period), 0, atol=1e-9)
            np.testing.assert_allclose(getattr(found.std, name), getattr(plain.std, name), rtol=1e-9)


def test_a_summary_crosses_the_wrap():
    made = summarise_draws(
        Model(), around((), centre=(0.3, pi / 2, pi, -pi / 2, pi)), None, None, np.array(0), level=0.9
    )
    for name in CIRCLES:
        half = 0.5 * getattr(PERIODS, name)
        assert abs(abs(getattr(made.mean, name)) - half) < 0.01
        assert getattr(made.std, name) == pytest.approx(0.05, rel=0.1)
        assert getattr(made.low, name) > 0 > getattr(made.high, name)  # upwards from low, across the wrap
        # 90 % of a normal distribution are within 1.64 standard deviations
        assert (getattr(made.high, name) - getattr(made.low, name)) % (2 * half) == pytest.approx(0.164, rel=0.15)


def test_an_angle_whose_prior_leaves_out_a_part_of_the_circle_lies_on_a_line():
    """Draws at both bounds: the shortest arc would lead through what the prior excludes."""
    model = Model(priors={"retardance": UniformAngle(5.9)})
    ends = np.where(np.arange(1000) % 2, 2.94, -2.94) + np.random.default_rng(4).uniform(-0.01, 0.01, 1000)
    p = around(())._replace(retardance=ends.reshape(4, 250))
    for used, line in ((model, True), (Model(), False)):
        made = summarise_draws(used, p, None, None, np.array(0), level=0.9)
        assert (made.low.retardance < made.high.retardance) == line


def test_equivalent_copies_have_equivalent_summaries():
    """Every copy reverses or shifts circles, so summaries of copies are the copies of summaries."""
    p = around((2,), width=0.02)
    plain = summarise_draws(Model(), p, None, None, np.zeros(2, int), 0.68)
    means = orbit(plain.mean)
    copies = orbit(p)
    for k in range(8):
        made = summarise_draws(Model(), Parameters(*(x[k] for x in copies)), None, None, np.zeros(2, int), 0.68)
        for name in Parameters._fields:
            np.testing.assert_allclose(getattr(made.mean, name), getattr(means, name)[k], atol=1e-9)
            np.testing.assert_allclose(getattr(made.std, name), getattr(plain.std, name), rtol=1e-6)
        np.testing.assert_allclose(made.ess, plain.ess, rtol=1e-6)


def test_only_pixels_without_draws_and_dropped_parameters_are_nan():
    model = Model(fixed={"retardance": 0.0, "diattenuation_angle": 0.4})
    status = np.array([0, int(Status.MASKED), int(Status.NON_FINITE), int(Status.NOT_CONVERGED)])
    nothing = np.full((4, 250, 4), np.nan)
    p = around((4,), width=0.01)._replace(retardance_angle=nothing, circularity=nothing)
    p = Parameters(*(np.where((status == 1) | (status == 2), np.nan, x) for x in p))
    made = summarise_draws(model, p, None, None, status, 0.68)
    for part in (made.mean, made.std, made.low, made.high):
        for name in Parameters._fields:
            expected = [True] * 4 if name in model.dropped else [False, True, True, False]
            assert np.isnan(getattr(part, name)).tolist() == expected, name
    for values in (made.ess, made.r_hat):
        assert np.isnan(values).tolist() == [False, True, True, False]
    assert made.mean.retardance[0] == made.std.retardance[0] == made.low.retardance[0] == 0
    assert made.mean.diattenuation_angle[0] == made.high.diattenuation_angle[0] == 0.4
    dropped = int(Status.UNIDENTIFIED_RETARDANCE_ANGLE | Status.UNIDENTIFIED_CIRCULARITY)
    assert made.status.tolist() == [dropped, 1, 2, 4 | dropped]


def test_what_the_draws_do_not_identify_is_flagged_by_their_width():
    rng = np.random.default_rng(5)
    p = around((2,))._replace(
        circularity=rng.uniform(-pi, pi, (4, 250, 2)), diattenuation=rng.uniform(-1, 1, (4, 250, 2))
    )
    stale = np.array([0, int(Status.UNIDENTIFIED_RETARDANCE | Status.BAD_FIT)])
    made = summarise_draws(Model(), p, None, None, stale, 0.68)
    unknown = int(Status.UNIDENTIFIED_CIRCULARITY | Status.UNIDENTIFIED_DIATTENUATION)
    assert made.status.tolist() == [unknown, unknown | int(Status.BAD_FIT)]


def test_blocks_and_parts_of_a_frame_give_the_summary_of_the_frame(monkeypatch):
    status = np.zeros((3, 4), np.int32)
    status[1, 2] = 1
    p = around((3, 4), count=50)
    whole = summarise_draws(Model(), p, None, None, status, 0.9)
    parts = [summarise_draws(Model(), Parameters(*(x[:, :, row] for x in p)), None, None, status[row], 0.9)
             for row in range(3)]  # fmt: skip
    monkeypatch.setattr("polinfer.sampling.blocks.VALUES", 500)
    for other in (Summary.join(parts, (3, 4)), summarise_draws(Model(), p, None, None, status, 0.9)):
        for part in ("mean", "std", "low", "high"):
            for name in Parameters._fields:
                a, b = (getattr(getattr(made, part), name) for made in (whole, other))
                np.testing.assert_array_equal(a, b)
        for name in ("status", "ess", "r_hat"):
            np.testing.assert_array_equal(getattr(other, name), getattr(whole, name))
    with pytest.raises(ValueError, match="12 pixels, but shape"):
        Summary.join(parts, (3, 5))
    with pytest.raises(ValueError, match="different levels"):
        Summary.join([parts[0], summarise_draws(Model(), p, None, None, status, 0.5)], (3, 5))
    with pytest.raises(ValueError, match="at least one"):
        Summary.join([], (0,))


def test_single_precision_stays_single_and_is_summed_in_double():
    p = around((2,), width=1e-4, dtype=np.float32)
    made = summarise_draws(Model(), p, None, None, np.zeros(2, int), 0.68)
    assert made.mean.retardance.dtype == made.low.circularity.dtype == made.ess.dtype == np.float32
    np.testing.assert_allclose(made.std.retardance, 1e-4, rtol=0.1)
    np.testing.assert_allclose([np.mean(x) for x in made.mean], CENTRE, atol=2e-5)


@pytest.mark.parametrize("level", [0.0, 1.0, -0.1, 1.5])
def test_levels_out_of_range_are_refused(level):
    with pytest.raises(ValueError, match="level must be"):
        summarise_draws(Model(), around(()), None, None, np.array(0), level)
