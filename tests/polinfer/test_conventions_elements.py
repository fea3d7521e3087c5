"""Retarders and diattenuators as the arguments of other packages rebuild our matrices by the published formulas."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import polinfer
from polinfer import Parameters, PolariserFirst, RetarderFirst, conventions
from tests.oracles import jones as oracle
from tests.polinfer.published import (
    EDGES,
    LINEAR,
    TIME,
    chromatix_elements,
    chromatix_matrix,
    katsu_diattenuator,
    katsu_retarder,
    moving,
    py_pol_diattenuator,
    py_pol_retarder,
    py_pol_retarder_linear,
    pypolar_retarder,
    same_up_to_phase,
)

ANGLE = st.floats(-3.2, 3.2)


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


def test_elliptical_retarders_are_refused_where_only_linear_ones_exist():
    p = Parameters(0.0, 0.0, np.array([1.0, 0.0, 1.0]), 0.4, np.array([0.0, 0.5, 0.5]))
    for function, package in [(conventions.to_pypolar_retarder, "pypolar"), (conventions.to_katsu_retarder, "katsu")]:
        with pytest.raises(ValueError, match=f"parameters .*{package} builds, got 1 of 3 .*to_{package}"):
            function(p)
        linear = function(Parameters(*(x[:2] if np.ndim(x) else x for x in p)))  # no retardance, so no ellipse either
        assert all(x.shape == (2,) for x in linear.values())
