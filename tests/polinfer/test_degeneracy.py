"""Eight parameter sets describe one matrix, and one of them stands for all."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from polinfer import Parameters, canonicalise, orbit
from polinfer.degeneracy import nearest
from tests.oracles import jones as oracle

PI = math.pi
TINY = 2.0**-52
REFERENCE = (1.0, PI / 4, PI, PI / 4, 0.0)
LIMITS = (1.0, PI / 2, PI, PI / 2, PI)


def special(limit):
    """Anything in a range, its ends, quarters and zero, and what rounding makes of them."""
    exact = [limit * k / 4 for k in range(-4, 5)]
    beside = [math.nextafter(x, side) for x in exact for side in (-limit, limit)]
    return st.one_of(st.floats(-limit, limit), st.sampled_from([*exact, *beside, TINY, -TINY, 1e-300]))


SETS = st.tuples(*(special(limit) for limit in LIMITS))
# where the two polarisers are equally near although D is not 0
TIED_POLARISERS = st.builds(
    lambda x, upper: (x[0], PI / 2 + x[0] / PI if upper else -x[0] / PI, *x[2:]),
    SETS,
    st.booleans(),
)
DTYPES = st.sampled_from([np.float64, np.float32])
ZERO_RETARDANCE = (0.0, 0.0, 0.0, -TINY, 2.0)  # reaches an angle of -pi/2 by rounding


def turned(x, period):
    """``x`` in (-period/2, period/2]."""
    return x - period * math.ceil(x / period - 0.5)


def copies_of(x, eps=0.0):
    """The polarisers and the retarders that are equal to those of x, from the list on paper; plain Python."""
    d, td, eta, te, xi = map(float, x)

    def put(angle, period):
        angle = turned(angle, period)
        return period / 2 if angle <= 4 * eps - period / 2 else angle

    polarisers = [(d, put(td, PI)), (-d, put(td + PI / 2, PI))]
    retarders = [(eta, te, xi), (-eta, te + PI / 2, xi), (eta, -te, xi + PI), (-eta, PI / 2 - te, xi + PI)]
    return polarisers, [(e, put(t, PI), put(c, 2 * PI)) for e, t, c in retarders]


def distances(polarisers, retarders, reference=REFERENCE):
    d, td, eta, te, xi = reference
    return (
        [(a - d) ** 2 + turned(2 * (b - td), 2 * PI) ** 2 for a, b in polarisers],
        [turned(a - eta, 2 * PI) ** 2 + turned(2 * (b - te), 2 * PI) ** 2 + turned(c - xi, 2 * PI) ** 2
         for a, b, c in retarders],
    )  # fmt: skip


def chosen(sets, squares, eps):
    """Nearest; tied within 64 eps (1 + distance); of those the largest, compared value by value within 4 eps."""
    least = min(squares)
    left = [s for s, square in zip(sets, squares, strict=True) if square <= least + 64 * eps * (1 + least)]
    for k in range(len(left[0])):
        top = max(s[k] for s in left)
        left = [s for s in left if s[k] >= top - 4 * eps]
    return left[0]


def rule(x, eps, reference=REFERENCE):
    polarisers, retarders = copies_of(x, eps)
    near, far = distances(polarisers, retarders, reference)
    return (*chosen(polarisers, near, eps), *chosen(retarders, far, eps))


def clear_of_the_jumps(x, eps, reference=REFERENCE, exact=32):
    """No decision is so close that the rounding of a copy could turn it. Ties are clear: they are 64 eps wide."""
    polarisers, retarders = copies_of(x)
    for sets, squares in zip((polarisers, retarders), distances(polarisers, retarders, reference), strict=True):
        for (a, p), (b, q) in itertools.combinations(zip(squares, sets, strict=True), 2):
            if exact * eps < abs(a - b) / (1 + min(a, b)) < 128 * eps:
                return False
            if any(1.5 * eps < abs(u - v) < 10 * eps for u, v in zip(p[1:], q[1:], strict=True)):
                return False
    ends = [p[1] + PI / 2 for p in polarisers] + [r[1] + PI / 2 for r in retarders] + [r[2] + PI for r in retarders]
    return not any(2.5 * eps < end < 10 * eps for end in ends)


def in_precision(x, dtype):
    limits = [dtype(limit) for limit in LIMITS]
    return [min(max(dtype(v), -limit), limit) for v, limit in zip(x, limits, strict=True)], float(np.finfo(dtype).eps)


@settings(max_examples=100, deadline=None)
@given(SETS, st.sampled_from(["retarder_first", "polariser_first"]))
def test_orbit_leaves_the_matrix_fixed(x, ordering):
    copies = orbit(Parameters(*x))
    for i in range(8):
        copy = [float(values[i]) for values in copies]
        np.testing.assert_allclose(oracle.jones(copy, ordering), oracle.jones(x, ordering), atol=1e-13)


@settings(max_examples=400, deadline=None)
@given(st.one_of(SETS, TIED_POLARISERS), DTYPES)
@example(ZERO_RETARDANCE, np.float64)
@example((0.0, 0.0, 0.0, 0.0, PI / 2), np.float64)
@example((0.0, PI / 2, 1.0, PI / 2, -PI / 2), np.float32)
@example((-0.6, PI / 2 - 0.6 / PI, -PI, 0.3, 0.2), np.float64)
@example((0.0, math.nextafter(-PI / 2, 0), 0.0, math.nextafter(-PI / 2, 0), math.nextafter(-PI, 0)), np.float64)
def test_all_eight_copies_have_one_canonical_member_which_is_its_own(x, dtype):
    x, eps = in_precision(x, dtype)
    assume(clear_of_the_jumps(x, eps))
    all_eight = canonicalise(orbit(Parameters(*x)))
    once = canonicalise(Parameters(*x))
    for values, one, again, limit in zip(all_eight, once, canonicalise(once), LIMITS, strict=True):
        assert values.dtype == one.dtype == dtype
        np.testing.assert_allclose(values, one, rtol=0, atol=16 * eps)
        assert again == one
        assert np.max(np.abs(values)) <= dtype(limit)


@settings(max_examples=400, deadline=None)
@given(st.one_of(SETS, TIED_POLARISERS), DTYPES)
@example(ZERO_RETARDANCE, np.float64)
@example((0.0, 0.0, 0.0, -TINY, PI / 2), np.float64)
def test_the_canonical_member_is_that_of_the_rule_written_out(x, dtype):
    x, eps = in_precision(x, dtype)
    assume(clear_of_the_jumps(x, eps))
    np.testing.assert_allclose(canonicalise(Parameters(*x)), rule(x, eps), rtol=0, atol=16 * eps)


@settings(max_examples=200, deadline=None)
@given(SETS, SETS)
def test_the_rule_holds_for_any_reference(x, reference):
    eps = float(np.finfo(float).eps)
    assume(clear_of_the_jumps(x, eps, reference))
    found = canonicalise(orbit(Parameters(*x)), Parameters(*reference))
    expected = np.broadcast_to(np.reshape(rule(x, eps, reference), (5, 1)), (5, 8))
    np.testing.assert_allclose(np.stack(found), expected, rtol=0, atol=1e-13)


@settings(max_examples=200, deadline=None)
@given(st.one_of(SETS, TIED_POLARISERS), st.sampled_from(["retarder_first", "polariser_first"]))
@example(ZERO_RETARDANCE, "retarder_first")
@example((0.3, -PI / 2, -PI, -PI / 2, -PI), "polariser_first")
def test_canonicalising_leaves_the_matrix_fixed_also_at_ties_and_at_the_wrap(x, ordering):
    expected = oracle.jones(x, ordering)
    for copy in zip(*canonicalise(orbit(Parameters(*x))), strict=True):
        np.testing.assert_allclose(oracle.jones([float(v) for v in copy], ordering), expected, rtol=0, atol=1e-12)


@settings(max_examples=200, deadline=None)
@given(st.one_of(SETS, TIED_POLARISERS))
def test_the_default_reference_gives_the_ranges_that_follow_on_paper(x):
    found = canonicalise(Parameters(*x))
    # an axis may be beyond pi/2 by the width of a tie, and is then written as beyond -pi/2
    assert -1e-13 <= found.retardance_angle <= PI / 2 or found.retardance_angle <= 1e-13 - PI / 2
    assert abs(found.circularity) <= PI / 2 + 1e-13
    # 4 |D| = 2 pi a - pi^2 at a tie, a the distance of the doubled axis from pi/2
    axis = found.diattenuation_angle + (0 if found.diattenuation >= 0 else PI / 2)
    beyond = abs(turned(axis - PI / 4, PI)) - PI / 4 - abs(found.diattenuation) / PI
    assert beyond <= 1e-13 if found.diattenuation >= 0 else beyond >= -1e-13


@settings(max_examples=200, deadline=None)
@given(st.one_of(SETS, TIED_POLARISERS))
def test_ties_follow_the_published_list_if_it_begins_with_the_greatest_set(x):
    eps = float(np.finfo(float).eps)
    assume(clear_of_the_jumps(x, eps, exact=8))  # copies that are tied by tolerance alone have no order in the list
    polarisers, retarders = copies_of(x, eps)
    greatest = chosen(polarisers, [0, 0], eps) + chosen(retarders, [0] * 4, eps)
    first = ()
    polarisers, retarders = copies_of(greatest, eps)
    for sets, squares in zip((polarisers, retarders), distances(polarisers, retarders), strict=True):
        least = min(squares)
        first += next(s for s, far in zip(sets, squares, strict=True) if far <= least + 64 * eps * (1 + least))
    np.testing.assert_allclose(canonicalise(Parameters(*x)), first, rtol=0, atol=1e-13)


@settings(max_examples=200, deadline=None)
@given(st.one_of(SETS, TIED_POLARISERS), st.lists(st.booleans(), min_size=8, max_size=8))
def test_of_allowed_copies_the_elements_choose_one_by_one_if_they_can(x, allowed):
    eps = float(np.finfo(float).eps)
    assume(any(allowed) and clear_of_the_jumps(x, eps))
    polarisers, retarders = copies_of(x, eps)
    near, far = distances(polarisers, retarders)
    pairs = [pair for pair, use in zip(itertools.product(range(2), range(4)), allowed, strict=True) if use]
    kept, others = (sorted({pair[k] for pair in pairs}) for k in (0, 1))
    polariser = chosen([polarisers[p] for p in kept], [near[p] for p in kept], eps)
    alone = polariser + chosen([retarders[r] for r in others], [far[r] for r in others], eps)
    found = nearest(orbit(Parameters(*x)), Parameters(*map(np.float64, REFERENCE)), np.array(allowed))
    together = [(near[p] + far[r], polarisers[p] + retarders[r]) for p, r in pairs]
    if any(np.allclose(values, alone, rtol=0, atol=1e-13) for _, values in together):
        expected = alone
    else:
        least, expected = min(together)
        assume(all(other == expected or total > least + 1e-9 for total, other in together))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13)


def test_the_rule_is_the_same_for_arrays_and_for_a_reference_of_every_pixel():
    generator = np.random.default_rng(3)
    x = generator.uniform(-1, 1, (5, 4, 6)) * np.reshape(LIMITS, (5, 1, 1))
    points = generator.uniform(-1, 1, (5, 4, 6)) * np.reshape(LIMITS, (5, 1, 1))
    x[:, 0] = np.reshape((0.0, 0.0, 0.5, 0.0, PI / 2), (5, 1))  # ties among others
    found, elsewhere = canonicalise(Parameters(*x)), canonicalise(Parameters(*x), Parameters(*points))
    for pixel in np.ndindex(4, 6):
        one, point = x[(slice(None), *pixel)], points[(slice(None), *pixel)]
        np.testing.assert_allclose([v[pixel] for v in found], rule(one, TINY), atol=1e-13)
        np.testing.assert_allclose([v[pixel] for v in elsewhere], rule(one, TINY, point), atol=1e-13)
    with pytest.raises(ValueError, match=r"reference has shape \(4, 6\)"):
        canonicalise(Parameters(*x[:, 0, 0]), Parameters(*points))


def test_minus_half_a_wave_stays_where_it_is_and_reaches_plus_through_a_copy_only():
    assert canonicalise(Parameters(0.2, 0.3, -PI, 0.3, 0.1)).retardance == -PI
    assert canonicalise(Parameters(0.2, 0.3, PI, 0.3, 0.1)).retardance == PI
    other = canonicalise(Parameters(0.2, 0.3, -PI, 0.3 - PI / 2, 0.1))
    np.testing.assert_allclose((other.retardance, other.retardance_angle), (PI, 0.3))


def test_zero_has_no_sign():
    found = canonicalise(orbit(Parameters(0.0, 0.3, 0.0, 0.4, 0.0)))
    assert not np.signbit(found.diattenuation).any()
    assert not np.signbit(found.retardance).any()


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


def test_an_unknown_reference_chooses_something_and_warns_of_nothing():
    p = Parameters(0.2, 0.3, 1.0, 0.4, 0.1)
    found = nearest(orbit(p), Parameters(*np.full(5, np.nan)))
    np.testing.assert_allclose(found, p)


def test_wrong_kinds_are_refused():
    with pytest.raises(TypeError, match="must be real"):
        orbit(Parameters(0.1j, 0.0, 0.0, 0.0, 0.0))
