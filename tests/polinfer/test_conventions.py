"""Conversions against the published formulas of other packages, written out, and against the packages themselves."""

import os
import subprocess
import sys
import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import polinfer
from polinfer import Parameters, PolariserFirst, RetarderFirst, conventions
from tests.oracles import jones as oracle

RNG = np.random.default_rng(8)
ANGLE = st.floats(-3.2, 3.2)
EDGES = [(eta, t, xi) for eta in (0.0, -0.0, np.pi, -np.pi, np.pi / 2, -0.7) for t in (0.0, -0.0, np.pi / 2, -np.pi / 2,
         np.pi / 4, -0.4) for xi in (0.0, -0.0, np.pi, -np.pi, np.pi / 2, 0.3)]  # fmt: skip
LINEAR = [case for case in EDGES if case[2] != 0.3 and abs(case[2]) != np.pi / 2]
SHAPES = [(), (1,), (2,), (2, 2), (3, 4), (2, 3, 2)]
FLIP = np.diag([1, -1])


# ---- the published formulas


def pypolar_retarder(theta, delta):
    p, q, c, s = np.exp(0.5j * delta), np.exp(-0.5j * delta), np.cos(theta), np.sin(theta)
    off = c * s * 2j * np.sin(delta / 2)
    return np.array([[c * c * p + s * s * q, off], [off, c * c * q + s * s * p]])


def py_pol_rotation(t):
    return np.array([[np.cos(t), np.sin(t)], [-np.sin(t), np.cos(t)]])


def py_pol_retarder_linear(ret, azimuth):
    return py_pol_rotation(-azimuth) @ np.diag([1, np.exp(-1j * ret)]) @ py_pol_rotation(azimuth)


def py_pol_retarder(ret, azimuth, ellipticity):
    """Retarder from the characteristic angles of the fast state (1, i tan e) rotated by the azimuth."""
    e = py_pol_rotation(-azimuth) @ np.array([np.cos(ellipticity), 1j * np.sin(ellipticity)])
    alpha, delay = np.arctan2(abs(e[1]), abs(e[0])), np.angle(e[1]) - np.angle(e[0])
    up, down, s = np.exp(0.5j * ret), np.exp(-0.5j * ret), 1j * np.sin(2 * alpha) * np.sin(ret / 2)
    c2, s2 = np.cos(alpha) ** 2, np.sin(alpha) ** 2
    return np.array([[c2 * up + s2 * down, s * np.exp(-1j * delay)], [s * np.exp(1j * delay), c2 * down + s2 * up]])


def py_pol_diattenuator(Tmax, Tmin, azimuth):
    return py_pol_rotation(-azimuth) @ np.diag(np.sqrt([Tmax, Tmin])) @ py_pol_rotation(azimuth)


def chromatix_elements(theta, eta, phi):
    s, c = np.sin(theta), np.cos(theta)
    scale = np.exp(-1j * eta / 2)
    off = scale * (1 - np.exp(1j * eta)) * s * c
    return (
        scale * (c**2 + np.exp(1j * eta) * s**2),
        off * np.exp(-1j * phi),
        off * np.exp(1j * phi),
        scale * (s**2 + np.exp(1j * eta) * c**2),
    )


def chromatix_matrix(j00, j01, j10, j11):
    return np.array([[0, 0, 0], [0, j11, j10], [0, j01, j00]])


def katsu_retarder(a, r):
    m = np.zeros((4, 4))
    m[0, 0] = 1
    m[1, 1] = np.cos(2 * a) ** 2 + np.cos(r) * np.sin(2 * a) ** 2
    m[1, 2] = m[2, 1] = (1 - np.cos(r)) * np.cos(2 * a) * np.sin(2 * a)
    m[1, 3] = -np.sin(r) * np.sin(2 * a)
    m[2, 2] = np.cos(r) * np.cos(2 * a) ** 2 + np.sin(2 * a) ** 2
    m[2, 3] = np.cos(2 * a) * np.sin(r)
    m[3, 1], m[3, 2], m[3, 3] = -m[1, 3], -m[2, 3], np.cos(r)
    return m


def katsu_diattenuator(a, Tmin, Tmax=1.0):
    m, total, difference, root = np.zeros((4, 4)), Tmax + Tmin, Tmax - Tmin, 2 * np.sqrt(Tmax * Tmin)
    c, s = np.cos(2 * a), np.sin(2 * a)
    m[0, 0] = total
    m[0, 1] = m[1, 0] = difference * c
    m[0, 2] = m[2, 0] = difference * s
    m[1, 1], m[2, 2], m[3, 3] = total * c**2 + root * s**2, root * c**2 + total * s**2, root
    m[1, 2] = m[2, 1] = (total - root) * c * s
    return m / 2


def katsu_from_jones(jones):
    u = np.array([[1, 0, 0, 1], [1, 0, 0, -1], [0, 1, 1, 0], [0, 1j, -1j, 0]]) * np.sqrt(1 / 2)
    return np.real(u @ np.kron(np.conj(jones), jones) @ np.linalg.inv(u))


# ---- what is measured in the laboratory: the electric field in time

TIME = np.linspace(0, 2 * np.pi, 64, endpoint=False)


def moving(field, sign):
    """Real field vectors (time, component) of a complex amplitude with the time factor e^{sign i omega t}."""
    return (np.asarray(field)[None, :] * np.exp(sign * 1j * TIME)[:, None]).real


def random_matrices(shape=(), dtype=np.complex128):
    return (RNG.normal(size=(*shape, 2, 2)) + 1j * RNG.normal(size=(*shape, 2, 2))).astype(dtype)


def same_up_to_phase(a, b, atol=1e-12):
    a, b = np.asarray(a), np.asarray(b)
    phase = np.vdot(a, b)
    phase = phase / abs(phase)
    np.testing.assert_allclose(a * phase, b, atol=atol)


PAIRS = {
    "pypolar": (conventions.to_pypolar, conventions.from_pypolar),
    "py_pol": (conventions.to_py_pol, conventions.from_py_pol),
    "chromatix": (conventions.to_chromatix, conventions.from_chromatix),
}


@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize("package", PAIRS)
@pytest.mark.parametrize("dtype", [np.complex64, np.complex128])
def test_there_and_back_is_the_identity(package, flip, dtype):
    to, back = PAIRS[package]
    for shape in SHAPES:
        matrices = random_matrices(shape, dtype)
        again = back(to(matrices, flip_vertical=flip), flip_vertical=flip)
        assert again.dtype == to(matrices).dtype == dtype
        np.testing.assert_array_equal(again, matrices)


@pytest.mark.parametrize("flip", [False, True])
def test_the_same_wave_comes_out_at_any_time(flip):
    """E(t) is real and the same in every package, up to the sense of y; only complex amplitudes differ."""
    ours, field = random_matrices(), random_matrices()[0]
    y = np.array([1, -1 if flip else 1])
    expected = moving(ours @ field, -1) * y
    conjugated = conventions.to_pypolar(ours, flip_vertical=flip) @ np.conj(y * field)
    np.testing.assert_allclose(moving(conjugated, +1), expected, atol=1e-13)
    np.testing.assert_allclose(
        moving(conventions.to_py_pol(ours, flip_vertical=flip) @ np.conj(y * field), +1), expected, atol=1e-13
    )
    zyx = conventions.to_chromatix(ours, flip_vertical=flip) @ np.array([0, y[1] * field[1], field[0]])
    assert zyx[0] == 0
    np.testing.assert_allclose(moving(zyx[:0:-1], -1), expected, atol=1e-13)


@pytest.mark.parametrize("flip", [False, True])
def test_stokes_vectors_are_those_of_the_moving_field(flip):
    """katsu: S3 > 0 for a field that turns clockwise for y up, as its fast axes and Mueller matrices imply."""

    def stokes(field_in_time):
        x, y = field_in_time.T
        turning = (x * np.roll(y, -1) - y * np.roll(x, -1)).mean() / np.sin(TIME[1])  # > 0: anticlockwise
        return 2 * np.array([(x * x + y * y).mean(), (x * x - y * y).mean(), 2 * (x * y).mean(), -turning])

    ours, field = random_matrices(), random_matrices()[0]
    y = np.array([1, -1 if flip else 1])
    before, after = stokes(moving(field, -1) * y), stokes(moving(ours @ field, -1) * y)
    np.testing.assert_allclose(conventions.to_katsu(ours, flip_vertical=flip) @ before, after, atol=1e-12)


RIGHT = {  # what each package calls right-handed circular light, as a real field in time
    "pypolar": moving(np.array([1, 1j]) / np.sqrt(2), +1),
    "py_pol": moving(np.array([1, 1j]) / np.sqrt(2), +1),
    "chromatix": moving(np.array([0, -1j, 1])[:0:-1] / np.sqrt(2), -1),
}


@pytest.mark.parametrize("package", RIGHT)
def test_right_handed_light_is_the_same_wave_everywhere(package):
    np.testing.assert_allclose(RIGHT[package], moving(np.array([1, -1j]) / np.sqrt(2), -1), atol=1e-15)
    passes_right = np.array([[1, 1j], [-1j, 1]]) / 2  # here: (1, -i) unchanged, (1, i) blocked
    theirs = {
        "pypolar": np.outer([1, 1j], np.conj([1, 1j])) / 2,
        "py_pol": np.outer([1, 1j], np.conj([1, 1j])) / 2,
        "chromatix": chromatix_matrix(1, 1j, -1j, 1) / 2,  # its right_circular_polarizer
    }[package]
    np.testing.assert_allclose(PAIRS[package][1](theirs), passes_right, atol=1e-15)
    np.testing.assert_allclose(conventions.to_katsu(passes_right)[:, 0], [0.5, 0, 0, 0.5], atol=1e-15)


PLATES = {
    "pypolar": lambda a, r: conventions.from_pypolar(pypolar_retarder(a, r)),
    "py_pol": lambda a, r: conventions.from_py_pol(py_pol_retarder_linear(r, a)),
    "chromatix": lambda a, r: conventions.from_chromatix(chromatix_matrix(*chromatix_elements(a, r, 0.0))),
    "katsu": lambda a, r: conventions.from_katsu(katsu_retarder(a, r)),
}
PLATE_PARAMETERS = {
    "pypolar": lambda a, r: conventions.from_pypolar_retarder(a, r),
    "py_pol": lambda a, r: conventions.from_py_pol_retarder(r, a),
    "chromatix": lambda a, r: conventions.from_chromatix_retarder(a, r),
    "katsu": lambda a, r: conventions.from_katsu_retarder(a, r),
}


@pytest.mark.parametrize("package", PLATES)
def test_light_along_the_fast_axis_of_a_quarter_wave_plate_is_a_quarter_period_ahead(package):
    fast, slow = np.array([np.cos(np.pi / 6), np.sin(np.pi / 6)]), np.array([-np.sin(np.pi / 6), np.cos(np.pi / 6)])
    for matrix in (
        PLATES[package](np.pi / 6, np.pi / 2),
        oracle.retarder(*PLATE_PARAMETERS[package](np.pi / 6, np.pi / 2)[2:]),
    ):
        out = moving(matrix @ (fast + slow), -1)
        ahead, behind = np.argmax(out @ fast), np.argmax(out @ slow)
        assert (behind - ahead) % len(TIME) == len(TIME) // 4


@pytest.mark.parametrize("package", PLATES)
@pytest.mark.parametrize("retardance", [0.0, 0.3, np.pi / 2, 3.0, np.pi])
@pytest.mark.parametrize("axis", [0.0, -0.0, np.pi / 6, np.pi / 2, 2.0, np.pi])
def test_plates_are_our_retarders(package, retardance, axis):
    expected = oracle.retarder(retardance, np.pi / 2 - axis, 0.0)
    same_up_to_phase(PLATES[package](axis, retardance), expected)
    same_up_to_phase(oracle.retarder(*PLATE_PARAMETERS[package](axis, retardance)[2:]), expected)


@pytest.mark.parametrize("flip", [False, True])
def test_arguments_of_retarders_rebuild_the_matrix(flip):
    """Our parameters, through the other package's own formula, give our matrix in its convention."""
    for eta, t, xi in EDGES:
        p, ours = Parameters(0.1, 0.2, eta, t, xi), oracle.retarder(eta, t, xi)
        for matrix, to in [
            (py_pol_retarder(**conventions.to_py_pol_retarder(p, flip_vertical=flip)), conventions.to_py_pol),
            (
                chromatix_matrix(*chromatix_elements(**conventions.to_chromatix_retarder(p, flip_vertical=flip))),
                conventions.to_chromatix,
            ),
        ]:
            same_up_to_phase(matrix, to(ours, flip_vertical=flip))
    for eta, t, xi in LINEAR:
        p, ours = Parameters(0.1, 0.2, eta, t, xi), oracle.retarder(eta, t, xi)
        same_up_to_phase(
            pypolar_retarder(**conventions.to_pypolar_retarder(p, flip_vertical=flip)),
            conventions.to_pypolar(ours, flip_vertical=flip),
        )
        np.testing.assert_allclose(
            katsu_retarder(**conventions.to_katsu_retarder(p, flip_vertical=flip)),
            conventions.to_katsu(ours, flip_vertical=flip),
            atol=1e-12,
        )


@pytest.mark.parametrize("flip", [False, True])
def test_arguments_lie_in_the_ranges_of_the_packages(flip):
    p = Parameters(0.1, 0.2, *np.array(EDGES).T)
    a = conventions.to_py_pol_retarder(p, flip_vertical=flip)
    assert np.all((a["ret"] >= 0) & (a["ret"] <= np.pi))
    assert np.all((a["azimuth"] >= 0) & (a["azimuth"] < np.pi))
    assert np.all(np.abs(a["ellipticity"]) <= np.pi / 4)
    b = conventions.to_chromatix_retarder(p, flip_vertical=flip)
    assert np.all((b["theta"] >= 0) & (b["theta"] < np.pi) & (b["eta"] >= 0) & (b["eta"] <= np.pi))
    for D in (-1.0, -0.3, -0.0, 0.0, 1.0):
        c = conventions.to_katsu_diattenuator(p._replace(diattenuation=D), flip_vertical=flip)
        assert np.all((c["Tmin"] >= 0) & (c["Tmax"] <= 2) & (c["a"] >= 0) & (c["a"] < np.pi))


def far_from_reference(p):
    """Squared distance of a parameter set from the reference point of the conventions."""
    a, b, c, d = (np.angle(np.exp(1j * x)) for x in (2 * p.retardance_angle - np.pi / 2, p.retardance - np.pi,
                  p.circularity, 2 * p.diattenuation_angle - np.pi / 2))  # fmt: skip
    return a**2 + b**2 + c**2 + d**2 + (p.diattenuation - 1) ** 2


def orbit_of(p):
    return np.array(polinfer.orbit(p)).T


@settings(max_examples=60, deadline=None)
@given(ANGLE, ANGLE, ANGLE, st.booleans())
def test_parameters_of_retarders_return(eta, t, xi, flip):
    p = Parameters(0.0, 0.0, eta, t, xi)
    for to, back in [
        (conventions.to_py_pol_retarder, conventions.from_py_pol_retarder),
        (conventions.to_chromatix_retarder, conventions.from_chromatix_retarder),
    ]:
        again = back(**to(p, flip_vertical=flip), flip_vertical=flip)
        assert float(again.diattenuation) == 0
        same_up_to_phase(oracle.retarder(*again[2:]), oracle.retarder(eta, t, xi))
        assert far_from_reference(again) <= min(far_from_reference(Parameters(*x)) for x in orbit_of(again)) + 1e-9


@settings(max_examples=60, deadline=None)
@given(st.floats(-1, 1), ANGLE, st.booleans())
def test_diattenuators_are_our_polarisers(D, angle, flip):
    p, ours = Parameters(D, angle, 0.3, 0.2, 0.1), oracle.polariser(D, angle)
    there = py_pol_diattenuator(**conventions.to_py_pol_diattenuator(p, flip_vertical=flip))
    np.testing.assert_allclose(there, conventions.to_py_pol(ours, flip_vertical=flip), atol=1e-12)
    there = katsu_diattenuator(**conventions.to_katsu_diattenuator(p, flip_vertical=flip))
    np.testing.assert_allclose(there, conventions.to_katsu(ours, flip_vertical=flip), atol=1e-12)
    for to, back in [
        (conventions.to_py_pol_diattenuator, conventions.from_py_pol_diattenuator),
        (conventions.to_katsu_diattenuator, conventions.from_katsu_diattenuator),
    ]:
        again = back(**to(p, flip_vertical=flip), flip_vertical=flip)
        np.testing.assert_allclose(oracle.polariser(*again[:2]), ours, atol=1e-7 if abs(D) > 0.999 else 1e-12)


def test_diattenuation_is_the_contrast_of_transmissions_whatever_their_mean():
    p = conventions.from_katsu_diattenuator(-0.3, np.array([0.25, 0.0, 1.0]))
    np.testing.assert_allclose(p.diattenuation, [0.6, 1, 0], atol=1e-15)
    assert np.isnan(conventions.from_py_pol_diattenuator(0.0, 0.0, 0.1).diattenuation)
    np.testing.assert_allclose(conventions.from_py_pol_diattenuator(0.2, 0.8, 0.1).diattenuation_angle % np.pi,
                               (np.pi / 2 - 0.1), atol=1e-12)  # fmt: skip


@pytest.mark.parametrize("ordering", [RetarderFirst(), PolariserFirst()])
def test_a_stack_built_there_is_fitted_with_the_predicted_parameters(ordering):
    """py_pol: diattenuator times retarder in the order of the product, decomposed here."""
    ret, azimuth, ellipticity, Tmax, Tmin, axis = 1.2, 0.9, 0.1, 0.9, 0.5, 2.6
    retarder = py_pol_retarder(ret, azimuth, ellipticity)
    diattenuator = py_pol_diattenuator(Tmax, Tmin, axis)
    first = isinstance(ordering, RetarderFirst)
    product = diattenuator @ retarder if first else retarder @ diattenuator
    found = polinfer.decompose(conventions.from_py_pol(product), ordering)
    expected_retarder = conventions.from_py_pol_retarder(ret, azimuth, ellipticity)
    expected_polariser = conventions.from_py_pol_diattenuator(Tmax, Tmin, axis)
    expected = [float(x) for x in (*expected_polariser[:2], *expected_retarder[2:])]
    np.testing.assert_allclose([float(x) for x in found], expected, atol=1e-12)
    assert found.diattenuation == pytest.approx((Tmax - Tmin) / (Tmax + Tmin))
    assert found.diattenuation_angle == pytest.approx(np.pi - axis)  # along (cos a, sin a), to the letter


def test_mueller_matrices_are_the_products_of_katsu():
    for _ in range(20):
        D, axis, eta, fast = RNG.uniform([0, -2, 0, -2], [1, 2, np.pi, 2])
        ours = oracle.polariser(D, -axis) @ oracle.retarder(eta, np.pi / 2 - fast, 0)
        expected = katsu_diattenuator(axis, 1 - D, 1 + D) @ katsu_retarder(fast, eta)
        np.testing.assert_allclose(conventions.to_katsu(ours), expected, atol=1e-13)
        matrix = random_matrices()
        np.testing.assert_allclose(conventions.to_katsu(matrix), katsu_from_jones(matrix), atol=1e-12)
    assert conventions.to_katsu(random_matrices((3, 2))).shape == (3, 2, 4, 4)


def test_pure_mueller_matrices_return_as_the_jones_matrices_of_the_model():
    cases = RNG.uniform([-0.99, -1.5, -3.1, -1.5, -3.1], [0.99, 1.5, 3.1, 1.5, 3.1], (100, 5))
    for ordering in ("retarder_first", "polariser_first"):
        matrices = np.stack([oracle.jones(x, ordering) for x in cases])
        again = conventions.from_katsu(conventions.to_katsu(matrices))
        np.testing.assert_allclose(again, matrices, atol=1e-12)  # the phase too: the model has det > 0, Re tr >= 0
        flipped = conventions.from_katsu(conventions.to_katsu(matrices, flip_vertical=True), flip_vertical=True)
        np.testing.assert_allclose(flipped, matrices, atol=1e-12)


@pytest.mark.parametrize("matrix", [
    np.diag([1.0, 0]), np.array([[0, 0], [2.0, 0]]), np.array([[0, 1.0], [1, 0]]), np.diag([1, -1.0]),
    np.diag([3j, 3j]), np.array([[1, 1j], [-1j, 1]]), 1e-8 * np.eye(2), 1e8 * np.diag([1, 1j]),
])  # fmt: skip
def test_singular_and_half_wave_matrices_return_up_to_a_phase(matrix):
    again = conventions.from_katsu(conventions.to_katsu(matrix))
    size = np.abs(matrix).max()
    same_up_to_phase(again / size, matrix / size, atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(again), np.linalg.norm(matrix), rtol=1e-7)


def test_depolarisation_is_refused_with_its_distance():
    """A mixture of plates with orthogonal Jones matrices has eigenvalues in the ratio of the mixture."""
    p = 0.1
    mixed = (1 - p) * conventions.to_katsu(np.eye(2)) + p * conventions.to_katsu(np.diag([1, -1]))
    distance = p / np.hypot(p, 1 - p)
    with pytest.raises(ValueError, match=rf"mueller .* 1 of 3 that depolarise.* {distance:.3g} .*tolerance"):
        conventions.from_katsu(np.stack([np.eye(4), mixed, np.eye(4)]))
    taken = conventions.from_katsu(mixed, tolerance=distance * 1.001)
    np.testing.assert_allclose(taken, np.sqrt(1 - p) * np.eye(2), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(mixed - conventions.to_katsu(taken)) / np.linalg.norm(mixed), distance)
    for unphysical in (-np.eye(4), np.diag([-1.0, 0, 0, 0])):  # no positive eigenvalue: nothing is nearer than 0
        with pytest.raises(ValueError, match="distance of 1 "):
            conventions.from_katsu(unphysical)


def test_the_nearest_pure_matrix_is_taken():
    noisy = conventions.to_katsu(random_matrices()) + 0.05 * RNG.normal(size=(4, 4))
    best = conventions.from_katsu(noisy, tolerance=1.0)
    error = np.linalg.norm(noisy - conventions.to_katsu(best))
    for _ in range(200):
        other = best + 10 ** RNG.uniform(-4, -1) * random_matrices()
        assert np.linalg.norm(noisy - conventions.to_katsu(other)) > error


def test_pixels_without_data_stay_nan_and_dark_ones_zero():
    mueller = np.stack([np.eye(4), np.full((4, 4), np.nan), np.zeros((4, 4))])
    jones = conventions.from_katsu(mueller)
    assert np.isnan(jones).all(axis=(-1, -2)).tolist() == [False, True, False]
    assert np.abs(jones[2]).max() == 0
    assert np.isnan(conventions.to_katsu(np.full((2, 2), np.nan))).all()
    hole = np.array([np.nan, 0.3])
    p = Parameters(hole, hole, hole, hole, np.zeros(2))
    for function in (conventions.to_py_pol_retarder, conventions.to_chromatix_retarder, conventions.to_katsu_retarder,
                     conventions.to_pypolar_retarder, conventions.to_katsu_diattenuator):  # fmt: skip
        values = {name: np.isnan(x).tolist() for name, x in function(p).items() if name != "phi"}
        assert all(v == [True, False] for v in values.values()), values


def test_no_negative_zeros_leave():
    """-1 - 0i has the phase -pi: packages read a handedness from such a sign."""
    plates = np.stack([np.eye(2), -np.eye(2), np.diag([1, -1]), np.array([[0, -1], [1, 0]])]).astype(complex)
    for to, _ in PAIRS.values():
        for flip in (False, True):
            there = to(plates, flip_vertical=flip)
            assert not np.signbit(there.imag).any()
            assert not np.signbit(there.real[there.real == 0]).any()


def test_single_precision_stays_single():
    p = Parameters(*(np.float32(x) * np.ones((2, 3), np.float32) for x in (0.3, 0.2, 1.0, 0.4, 0.0)))
    for name in ("pypolar_retarder", "py_pol_retarder", "py_pol_diattenuator", "chromatix_retarder",
                 "katsu_retarder", "katsu_diattenuator"):  # fmt: skip
        arguments = getattr(conventions, f"to_{name}")(p)
        assert {x.dtype for x in arguments.values()} == {np.dtype(np.float32)}, name
        back = getattr(conventions, f"from_{name}")(**arguments)
        assert {x.dtype for x in back} == {np.dtype(np.float32)}, name
        wanted = p[:2] if name.endswith("diattenuator") else p[2:]
        for got, want in zip(back[:2] if name.endswith("diattenuator") else back[2:], wanted, strict=True):
            assert got.shape == (2, 3)
            np.testing.assert_allclose(got, want, atol=1e-6)
    single = random_matrices((5,), np.complex64)
    mueller = conventions.to_katsu(single)
    assert mueller.dtype == np.float32
    again = conventions.from_katsu(mueller)
    assert again.dtype == np.complex64
    for a, b in zip(again, single, strict=True):
        same_up_to_phase(a, b, atol=1e-5)


def test_elliptical_retarders_are_refused_where_only_linear_ones_exist():
    p = Parameters(0.0, 0.0, np.array([1.0, 0.0, 1.0]), 0.4, np.array([0.0, 0.5, 0.5]))
    for function, package in [(conventions.to_pypolar_retarder, "pypolar"), (conventions.to_katsu_retarder, "katsu")]:
        with pytest.raises(ValueError, match=f"parameters .*{package} builds, got 1 of 3 .*to_{package}"):
            function(p)
        linear = function(Parameters(*(x[:2] if np.ndim(x) else x for x in p)))  # no retardance, so no ellipse either
        assert all(x.shape == (2,) for x in linear.values())


@pytest.mark.parametrize(("call", "error", "message"), [
    (lambda: conventions.to_pypolar(np.eye(3)), ValueError, "jones must have shape"),
    (lambda: conventions.from_pypolar(np.zeros((2, 2, 5))), ValueError, "matrix must have shape"),
    (lambda: conventions.from_py_pol(np.zeros((5, 2, 2))), ValueError, r"matrix .*np\.moveaxis"),
    (lambda: conventions.from_py_pol_object(np.eye(2)), TypeError, "matrix .*from_py_pol, "),
    (lambda: conventions.from_chromatix(np.ones((3, 3))), ValueError, "matrix must not couple z"),
    (lambda: conventions.from_chromatix(np.eye(2)), ValueError, "matrix must have shape"),
    (lambda: conventions.from_katsu(np.eye(3)), ValueError, "mueller must have shape"),
    (lambda: conventions.from_katsu(np.eye(4), tolerance=-1), ValueError, "tolerance must be"),
    (lambda: conventions.to_katsu_retarder((0, 0, 1, 0, 0)), TypeError, "parameters must be Parameters"),
    (lambda: conventions.to_py_pol_diattenuator(Parameters(1.2, 0, 0, 0, 0)), ValueError, "diattenuation must be <= 1"),
    (lambda: conventions.from_katsu_diattenuator(0.1, -0.1), ValueError, "Tmin must be >= 0"),
    (lambda: conventions.from_katsu_retarder(np.zeros(2), np.zeros(3)), ValueError, "r has pixel shape"),
])  # fmt: skip
def test_errors_name_the_argument_and_the_remedy(call, error, message):
    with pytest.raises(error, match=message):
        call()


def test_without_py_pol_only_its_objects_are_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "py_pol.jones_matrix", None)
    with pytest.raises(ImportError, match=r"pip install 'polinfer\[peers\]'"):
        conventions.to_py_pol_object(np.eye(2))
    assert conventions.to_py_pol(np.eye(2)).shape == (2, 2)


# ---- the packages themselves


@pytest.fixture
def real_py_pol():
    return pytest.importorskip("py_pol.jones_matrix", reason="py_pol is not installed (pip install 'polinfer[peers]')")


@pytest.fixture
def real_pypolar():
    return pytest.importorskip("pypolar.jones", reason="pypolar is not installed (pip install 'polinfer[peers]')")


def test_pypolar_builds_what_its_formulas_say(real_pypolar):
    for axis, delta in [(0.0, 1.0), (0.4, -1.1), (np.pi / 6, np.pi / 2), (np.pi / 2, np.pi), (2.0, 0.0)]:
        there = real_pypolar.op_retarder(axis, delta)
        np.testing.assert_allclose(there, pypolar_retarder(axis, delta), atol=1e-15)
        np.testing.assert_allclose(conventions.from_pypolar(there), oracle.retarder(-delta, -axis, 0), atol=1e-14)
        np.testing.assert_allclose(
            conventions.from_pypolar(real_pypolar.op_linear_polarizer(axis)),
            oracle.polariser(1, -axis) / np.sqrt(2),
            atol=1e-14,
        )
        flipped = conventions.from_pypolar(there, flip_vertical=True)
        np.testing.assert_allclose(flipped, oracle.retarder(-delta, axis, 0), atol=1e-14)
    for eta, t, xi in LINEAR:
        p = Parameters(0.0, 0.0, eta, t, xi)
        there = real_pypolar.op_retarder(**conventions.to_pypolar_retarder(p))
        same_up_to_phase(there, conventions.to_pypolar(oracle.retarder(eta, t, xi)))


def test_pypolar_interprets_converted_light_as_the_same_hand(real_pypolar):
    ours = conventions.from_pypolar(real_pypolar.op_quarter_wave_plate(np.pi / 4))
    field = np.array([1, 0])
    there = np.conj(ours @ field)  # the circular state that our matrix makes, in pypolar's convention
    assert "Right circular" in real_pypolar.interpret(there)
    same_up_to_phase(there, real_pypolar.field_right_circular())
    for matrix in random_matrices((10,)):
        np.testing.assert_allclose(
            real_pypolar.jones_op_to_mueller_op(conventions.to_pypolar(matrix)),
            conventions.to_katsu(matrix),
            atol=1e-12,
        )


def test_py_pol_objects_hold_the_same_matrices(real_py_pol):
    filters = list(warnings.filters)
    for shape in SHAPES:
        ours = random_matrices(shape)
        there = conventions.to_py_pol_object(ours, name="sample")
        assert there.name == "sample"
        again = conventions.from_py_pol_object(there)
        assert again.shape == ((2, 2) if shape == (1,) else ours.shape)  # one matrix has the shape (1,) there
        np.testing.assert_array_equal(again.reshape(ours.shape), ours)
        stored = there.parameters.matrix()
        np.testing.assert_array_equal(conventions.from_py_pol(stored).reshape(ours.shape), ours)
    assert warnings.filters == filters
    assert conventions.from_py_pol_object(real_py_pol.Jones_matrix().quarter_waveplate()).shape == (2, 2)


def test_py_pol_is_imported_late_and_its_warnings_do_not_escape(real_py_pol, tmp_path):
    """A fresh interpreter in which every warning is an error, and the first import compiles py_pol."""
    lines = [
        "import sys, warnings, numpy as np",
        "from polinfer import conventions",
        "assert 'py_pol' not in sys.modules",
        "warnings.simplefilter('error')",
        "before = list(warnings.filters)",
        "there = conventions.to_py_pol_object(np.diag([1, 1j]))",
        "assert warnings.filters == before, warnings.filters",
        "assert abs(there.M[1, 1, 0] + 1j) < 1e-15",
    ]
    environment = {**os.environ, "PYTHONPYCACHEPREFIX": str(tmp_path), "JAX_PLATFORMS": "cpu"}
    subprocess.run([sys.executable, "-c", "\n".join(lines)], env=environment, check=True, timeout=300)


def test_py_pol_builds_what_its_formulas_say(real_py_pol):
    # arrays of two: py_pol 1.3 cannot build an elliptical retarder from single numbers with NumPy 2.4
    for eta, t, xi in [*EDGES, (1.1, 0.6, 2.0), (-2.5, -1.2, -0.4)]:
        p = Parameters(0.0, 0.0, *(np.full(2, x) for x in (eta, t, xi)))
        arguments = conventions.to_py_pol_retarder(p)
        there = real_py_pol.Jones_matrix().retarder_azimuth_ellipticity(**arguments)
        for matrix in conventions.from_py_pol_object(there):
            same_up_to_phase(matrix, oracle.retarder(eta, t, xi), atol=1e-9)
    for R, axis in [(0.0, 0.3), (1.0, 0.0), (np.pi / 2, np.pi / 6), (np.pi, 2.0)]:
        there = real_py_pol.Jones_matrix().retarder_linear(R, azimuth=axis)
        same_up_to_phase(there.M[..., 0], py_pol_retarder_linear(R, axis))
        same_up_to_phase(conventions.from_py_pol_object(there), oracle.retarder(R, np.pi / 2 - axis, 0))
    for D, axis in [(-1.0, 0.3), (-0.2, -0.3), (0.0, 0.1), (0.6, np.pi / 2), (1.0, -np.pi / 2)]:
        arguments = conventions.to_py_pol_diattenuator(Parameters(D, axis, 0.0, 0.0, 0.0))
        there = real_py_pol.Jones_matrix().diattenuator_linear(**arguments)
        np.testing.assert_allclose(conventions.from_py_pol_object(there), oracle.polariser(D, axis), atol=1e-12)


def test_a_py_pol_stack_has_the_predicted_parameters(real_py_pol):
    azimuth, axis = np.array([0.9, 0.4]), np.array([2.6, 1.9])
    retarder = real_py_pol.Jones_matrix().retarder_azimuth_ellipticity(
        ret=np.array([1.2, 2.0]), azimuth=azimuth, ellipticity=np.array([0.1, -0.2])
    )
    polariser = real_py_pol.Jones_matrix().diattenuator_linear(Tmax=0.9, Tmin=0.5, azimuth=axis)
    r = conventions.from_py_pol_retarder([1.2, 2.0], azimuth, [0.1, -0.2])
    d = conventions.from_py_pol_diattenuator(0.9, 0.5, axis)
    for product, ordering in [(polariser * retarder, RetarderFirst()), (retarder * polariser, PolariserFirst())]:
        found = polinfer.decompose(conventions.from_py_pol_object(product), ordering)
        np.testing.assert_allclose(np.array(found), np.array([*d[:2], *r[2:]]), atol=1e-9)


def test_py_pol_takes_our_result_apart_in_the_order_of_the_matrix_product(real_py_pol):
    p = Parameters(np.array([0.3, 0.5]), np.array([0.4, -0.8]), np.array([1.0, 2.0]), np.array([0.6, 0.2]), np.zeros(2))
    there = conventions.to_py_pol_object(RetarderFirst().jones(p))
    retarder, diattenuator = there.analysis.decompose_pure("PR")
    for i, values in enumerate(np.array(p).T):
        same_up_to_phase(conventions.from_py_pol_object(diattenuator)[i], oracle.polariser(*values[:2]), atol=1e-6)
        same_up_to_phase(conventions.from_py_pol_object(retarder)[i], oracle.retarder(*values[2:]), atol=1e-6)
