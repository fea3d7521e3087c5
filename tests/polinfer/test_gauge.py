"""The smooth gauge finds the field again, up to one of eight copies for the whole of it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from polinfer import Parameters, Status, canonicalise, orbit, smooth_gauge
from tests.oracles import jones as oracle

PERIODS = (np.inf, np.pi, 2 * np.pi, np.pi, 2 * np.pi)


def difference(a, b):
    """Largest difference of the five, angles modulo their periods."""
    worst = 0.0
    for x, y, period in zip(a, b, PERIODS, strict=True):
        d = np.asarray(x, float) - y
        worst = np.maximum(worst, np.abs(d if np.isinf(period) else d - period * np.round(d / period)))
    return worst


def wave(rng, shape, height, cycles=0.8):
    """A smooth field that crosses 0 and fills about [-height, height]."""
    y, x = np.mgrid[: shape[0], : shape[1]] / max(*shape, 40)
    turns = [rng.normal(size=2) * cycles for _ in range(3)]
    return height * np.mean([np.sin(2 * np.pi * (a * y + b * x) + rng.uniform(0, 7)) for a, b in turns], axis=0) * 1.6


def scene(seed, shape, whole_turns=False):
    """Every tie is crossed: D, eta and sin 2 theta_eta change sign along lines, axes and xi turn all round."""
    rng = np.random.default_rng(seed)
    eta = wave(rng, shape, 5.0) if whole_turns else np.pi * np.sin(wave(rng, shape, 1.5))
    d = np.sin(wave(rng, shape, 1.0))
    return Parameters(d, wave(rng, shape, 2.0), eta, wave(rng, shape, 2.0), wave(rng, shape, 4.0))


def mixed(truth, rng):
    """A copy drawn at random in every pixel."""
    copies, drawn = orbit(truth), rng.integers(0, 8, np.shape(truth.diattenuation))
    return Parameters(*(np.take_along_axis(values, drawn[None], axis=0)[0] for values in copies))


def nearest_copy(found, truth):
    """Largest difference from the one of the eight copies of the whole truth that is nearest."""
    return min(np.max(difference(found, copy)) for copy in zip(*orbit(truth), strict=True))


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([(41, 37), (1, 60), (60, 1), (1, 1)]), st.booleans())
def test_a_smooth_field_that_crosses_every_tie_is_found_whole(seed, shape, whole_turns):
    truth = scene(seed, shape, whole_turns)
    found = smooth_gauge(mixed(truth, np.random.default_rng(seed)))
    assert nearest_copy(found, truth) < 1e-9


def test_the_crossings_are_real_and_canonicalising_tears_them():
    truth = scene(4, (82, 74))
    for values, span in zip(truth, (0.3, 1.6, 2.5, 1.6, 3.1), strict=True):
        assert values.min() < -span < span < values.max()
    step = np.max(difference([x[1:] for x in truth], [x[:-1] for x in truth]))
    torn, smooth = canonicalise(truth), smooth_gauge(truth)
    assert step < 1
    assert np.max(difference([x[1:] for x in torn], [x[:-1] for x in torn])) > 1.5
    assert np.max(difference([x[1:] for x in smooth], [x[:-1] for x in smooth])) == pytest.approx(step, abs=1e-9)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_any_field_at_all_keeps_its_matrices_and_the_copies_that_came_play_no_part(seed):
    rng = np.random.default_rng(seed)
    given = Parameters(*(rng.uniform(-h, h, (4, 5)) for h in (1, np.pi / 2, np.pi, np.pi / 2, np.pi)))
    found, again = smooth_gauge(given), smooth_gauge(mixed(given, rng))
    assert np.max(difference(found, again)) < 1e-12
    for ordering in ("retarder_first", "polariser_first"):
        for pixel in np.ndindex(4, 5):
            a, b = ([float(x[pixel]) for x in p] for p in (given, found))
            np.testing.assert_allclose(oracle.jones(b, ordering), oracle.jones(a, ordering), atol=1e-12)
    for values, limit in zip(found, (1, np.pi / 2, np.pi, np.pi / 2, np.pi), strict=True):
        assert np.max(np.abs(values)) <= limit


@settings(max_examples=30, deadline=None)
@given(st.tuples(*(st.floats(-h, h) for h in (1, np.pi / 2, np.pi, np.pi / 2, np.pi))))
def test_a_single_pixel_is_as_near_to_the_reference_as_its_canonical_copy(x):
    found, expected = smooth_gauge(Parameters(*x)), canonicalise(Parameters(*x))
    assert all(np.shape(value) == () for value in found)

    def far(p):
        angles = (2 * p[1] - np.pi / 2, p[2] - np.pi, 2 * p[3] - np.pi / 2, p[4])
        return (p[0] - 1) ** 2 + sum(np.angle(np.exp(1j * a)) ** 2 for a in angles)

    assert far(found) == pytest.approx(far(expected), abs=1e-9)


def test_on_the_whole_the_gauge_is_the_one_nearest_to_the_reference():
    canonical = Parameters(*(np.full((6, 7), x) for x in (0.3, 0.6, 1.2, 0.7, 0.1)))
    few = canonical.diattenuation.copy()
    few[:, :2] *= -0.5
    found = smooth_gauge(canonical._replace(diattenuation=few, diattenuation_angle=canonical.diattenuation_angle))
    np.testing.assert_array_equal(found.diattenuation, few)  # negative in the minority, where the axis goes on
    np.testing.assert_array_equal(found.retardance, canonical.retardance)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.floats(-1, 1), st.floats(-np.pi / 2, np.pi / 2)), min_size=2, max_size=2))
def test_two_polarisers_are_as_near_as_the_canonical_distance_allows(pixels):
    (d, t), (e, u) = pixels
    found = smooth_gauge(Parameters(np.array([d, e]), np.array([t, u]), 1.0, 0.4, 0.2))

    def square(d, t, e, u):
        return (d - e) ** 2 + np.angle(np.exp(2j * (t - u))) ** 2

    least = min(square(d, t, e, u), square(d, t, -e, u + np.pi / 2))
    x, y = found.diattenuation, found.diattenuation_angle
    assert square(x[0], y[0], x[1], y[1]) == pytest.approx(least, abs=1e-9)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(*(st.floats(-h, h) for h in (np.pi, np.pi / 2, np.pi))), min_size=2, max_size=2))
def test_two_retarders_are_as_near_as_their_axes_on_the_sphere_allow(pixels):
    given = [np.array(values) for values in zip(*pixels, strict=True)]
    found = smooth_gauge(Parameters(0.1, 0.2, *given))

    def pair(eta, t, xi):
        axis = np.stack([np.cos(2 * t), np.sin(2 * t) * np.cos(xi), np.sin(2 * t) * np.sin(xi)])
        return eta, axis

    def square(eta, axis):
        angle = 2 * np.arcsin(np.clip(np.linalg.norm(axis[:, 0] - axis[:, 1]) / 2, 0, 1))
        return angle**2 + np.angle(np.exp(1j * (eta[0] - eta[1]))) ** 2

    eta, axis = pair(*given)
    least = min(square(sign * eta, sign * axis) for sign in (np.ones(2), np.array([1, -1])))
    assert square(*pair(*found[2:])) == pytest.approx(least, abs=1e-6)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_of_two_equally_near_gauges_the_first_pixel_decides(seed):
    # with the axis at 0 or 90 degrees, and as much of D on either side, both are equally near to the reference
    rng = np.random.default_rng(seed)
    d = rng.uniform(-0.5, 0.5, 8)
    d -= d.mean()
    found = smooth_gauge(Parameters(d, 0.0, 1.0, 0.4, 0.2))
    np.testing.assert_array_equal(found.diattenuation, d * np.sign(d[0]))


def test_gaps_are_gone_round_and_islands_stand_for_themselves():
    truth = scene(11, (40, 30))
    rng = np.random.default_rng(0)
    hole = rng.random((40, 30)) < 0.2
    hole[20] = True
    given = mixed(truth, rng)
    axis, xi = (np.where(hole, np.nan, x) for x in (given.diattenuation_angle, given.circularity))
    given = given._replace(diattenuation_angle=axis, circularity=xi)
    found = smooth_gauge(given)
    for values, came in zip(found, given, strict=True):
        np.testing.assert_array_equal(values[hole], came[hole])
        assert not np.isnan(values[~hole]).any()
    from scipy.ndimage import label

    islands, count = label(~hole)
    assert count >= 2
    for k in range(1, count + 1):
        chosen = islands == k
        part = Parameters(*(np.where(chosen, x, np.nan) for x in truth))
        alone = smooth_gauge(part)
        assert np.max(difference([x[chosen] for x in found], [x[chosen] for x in alone])) < 1e-9
        assert nearest_copy([x[chosen] for x in found], Parameters(*(x[chosen] for x in truth))) < 1e-9


def test_pixels_without_an_answer_stay_as_they_came_and_connect_nothing():
    # with D > 0 the left half alone is nearest to the reference, with D < 0 the right one
    angle = np.linspace(0.5, 2.3, 11)
    given = Parameters(np.full(11, 0.3), angle, 1.0, 0.7, 0.1)
    together = smooth_gauge(given).diattenuation
    assert np.unique(together).size == 1
    mute, apart = np.arange(11) == 5, [0.3] * 6 + [-0.3] * 5
    flags = Status.UNIDENTIFIED_DIATTENUATION_ANGLE | Status.BAD_FIT
    np.testing.assert_array_equal(smooth_gauge(given, np.where(mute, int(flags), 0)).diattenuation, together)
    assert smooth_gauge(given, np.where(mute, int(Status.NOT_CONVERGED), 0)).diattenuation.tolist() == apart
    unknown_axis = smooth_gauge(given._replace(diattenuation_angle=np.where(mute, np.nan, angle)))
    assert unknown_axis.diattenuation.tolist() == apart


def test_a_polariser_without_axis_stays_and_the_retarder_is_still_smooth():
    eta, unknown = np.array([1.0, 0.5, 0.1, -0.2, -0.3]), np.full(5, np.nan)
    truth = Parameters(np.array([0.3, -0.1, 0.2, -0.1, -0.3]), 0.0, eta, 0.7, 0.1)
    found = smooth_gauge(
        mixed(truth, np.random.default_rng(1))._replace(diattenuation_angle=unknown, diattenuation=eta)
    )
    np.testing.assert_array_equal(found.diattenuation, eta)
    np.testing.assert_allclose(found.retardance, eta, atol=1e-12)
    d, axis = np.array([0.05, -0.3, -0.4, 0.2]), np.array([0.1, 0.1, 0.1, np.nan])
    last = smooth_gauge(Parameters(d, axis, 1.0, 0.7, 0.1)).diattenuation[-1]
    assert last == 0.2
    pure = smooth_gauge(truth._replace(circularity=np.nan, diattenuation=0.0))
    np.testing.assert_array_equal(pure.retardance, eta)


def test_exact_zeros_and_the_ends_of_the_retardance_do_not_break_the_line():
    n = 21
    truth = Parameters(
        np.linspace(-1, 1, n).round(12),
        np.linspace(0, 2, n),
        np.linspace(-np.pi, np.pi, n).round(12) + 0.0,
        np.linspace(-1.0, 1.0, n).round(12),
        np.linspace(-3, 3, n),
    )
    for values in truth[0], truth[2], truth[3]:
        assert values[n // 2] == 0
    assert nearest_copy(smooth_gauge(mixed(truth, np.random.default_rng(3))), truth) < 1e-9


def test_frames_along_leading_axes_are_separate():
    frames = [scene(seed, (12, 9)) for seed in range(6)]
    stack = Parameters(*(np.reshape(values, (2, 3, 12, 9)) for values in zip(*frames, strict=True)))
    found = smooth_gauge(stack)
    for k, frame in enumerate(frames):
        alone = smooth_gauge(frame)
        np.testing.assert_array_equal(np.stack([x[k // 3, k % 3] for x in found]), np.stack(alone))


def test_single_precision_stays_and_finds_the_same_copies():
    truth = scene(5, (30, 33))
    single = Parameters(*(x.astype(np.float32) for x in mixed(truth, np.random.default_rng(1))))
    found = smooth_gauge(single)
    assert all(values.dtype == np.float32 for values in found)
    assert nearest_copy(found, truth) < 1e-5


@pytest.mark.parametrize(("sigma", "seeds"), [(0.01, 4), (0.03, 4)])
def test_noise_flips_only_where_the_data_do_not_tell(sigma, seeds):
    # noise on the invariants: the vector of the diattenuator, the vector part of the retarder's quaternion
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        truth = scene(seed, (50, 50))
        d, t = truth.diattenuation, 2 * truth.diattenuation_angle
        u = np.stack([d * np.cos(t), d * np.sin(t)]) + sigma * rng.normal(size=(2, 50, 50))
        half, s, xi = 0.5 * truth.retardance, 2 * truth.retardance_angle, truth.circularity
        v = np.sin(half) * np.stack([np.cos(s), np.sin(s) * np.cos(xi), np.sin(s) * np.sin(xi)])
        v = v + sigma * rng.normal(size=v.shape)
        size, inside = np.minimum(np.hypot(*u), 1), np.arcsin(np.minimum(np.linalg.norm(v, axis=0), 1))
        polar, azimuth = np.arctan2(np.hypot(v[1], v[2]), v[0]), np.arctan2(v[2], v[1])
        measured = Parameters(size, 0.5 * np.arctan2(u[1], u[0]), 2 * inside, 0.5 * polar, azimuth)
        found = smooth_gauge(measured)
        clear = (np.abs(d) > 6 * sigma) & (np.abs(np.sin(half) * np.sin(s)) > 6 * sigma)
        assert 0.3 < clear.mean() < 0.9
        labels = np.argmin([difference(found, copy) for copy in zip(*orbit(truth), strict=True)], axis=0)[clear]
        assert (labels == labels[0]).all()


def test_an_inevitable_jump_lies_where_the_diattenuation_is_least():
    # on the way round the middle the axis turns by 90 degrees, so that one line from the middle to the border must jump
    y, x = np.mgrid[:20, :20] - 9.5
    azimuth = np.arctan2(y, x)
    weak = (np.abs(azimuth - 1.0) < 0.25) | (np.hypot(x, y) < 3)
    found = smooth_gauge(Parameters(np.where(weak, 0.02, 0.2), 0.25 * azimuth, 1.0, 0.7, 0.1))
    jumps = 0
    for k in (0, 1):
        turned = np.abs(np.sin(np.diff(found.diattenuation_angle, axis=k))) > 0.6
        beside = np.take(weak, np.arange(19), axis=k) | np.take(weak, np.arange(1, 20), axis=k)
        assert not np.any(turned & ~beside)
        jumps += turned.sum()
    assert jumps >= 8
    assert set(np.sign(found.diattenuation.ravel())) == {-1, 1}


def test_nothing_in_nothing_out():
    found = smooth_gauge(Parameters(*(np.zeros((0, 4)) for _ in range(5))))
    assert all(values.shape == (0, 4) for values in found)
    lost = smooth_gauge(Parameters(*(np.full((2, 2), np.nan) for _ in range(5))))
    assert all(np.isnan(values).all() for values in lost)


def test_wrong_kinds_are_refused():
    p = Parameters(*(np.full((2, 3), 0.1) for _ in range(5)))
    with pytest.raises(TypeError, match="must be real"):
        smooth_gauge(p._replace(retardance=1j))
    with pytest.raises(TypeError, match="status must be integer, got bool"):
        smooth_gauge(p, np.ones((2, 3), bool))
    with pytest.raises(ValueError, match=r"status has pixel shape \(4,\)"):
        smooth_gauge(p, np.zeros(4, int))
    with pytest.raises(ValueError, match=r"status has shape \(5, 2, 3\), more than"):
        smooth_gauge(p, np.zeros((5, 2, 3), int))
