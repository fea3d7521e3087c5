"""On a bound and near it, what the fast route tells is the integral over the part inside."""

from math import pi

import numpy as np
import pytest
from scipy import integrate

from polinfer import (
    ComplexGain,
    Model,
    PhaseGain,
)
from polinfer.fitting.fast import describe, edges, scene


def rows_of(count, known):
    return np.zeros((describe.rows(known), count))


def cell(i, j):
    return describe.ROWS["covariance"].start + 5 * i + j


def integral(density, low, high, *moments):
    """The integral of a density and of moments times it."""
    points = [low + (high - low) * x for x in (1e-6, 1e-4, 1e-2, 0.1)]
    points += [high - (high - low) * x for x in (1e-6, 1e-4, 1e-2, 0.1)]
    return [
        integrate.quad(lambda x, f=f: f(x) * density(x), low, high, points=points, limit=400, epsabs=0, epsrel=1e-10)[0]
        for f in (lambda x: 1.0, *moments)
    ]


# the width of the Gaussian, and by how many widths its peak lies beyond the bound
CUTS = [(1e-4, 0.0), (0.02, 0.3), (0.02, 3.0), (0.1, 0.0), (0.1, 20.0), (0.1, 31.0), (0.1, 60.0), (0.3, 1.0)]


def test_on_the_bound_of_the_retardance_moments_and_evidence_are_those_of_a_cut_gaussian():
    known = scene.scene(Model())
    out = rows_of(len(CUTS), known)
    for p, (width, beyond) in enumerate(CUTS):
        out[2, p] = pi
        out[cell(2, 2), p] = width**2
        out[cell(2, 4), p] = out[cell(4, 2), p] = -0.7  # circularity moves by -0.7 of the angle eta/2
        out[cell(4, 4), p] = 0.05**2
        out[cell(1, 1), p] = 0.1**2
        out[describe.ROWS["slope_2"], p] = beyond / width
    edges.correct_edges(known, out, np.full(len(CUTS), describe.FROZEN[2]))
    for p, (width, beyond) in enumerate(CUTS):

        def density(t, width=width, beyond=beyond):
            return np.exp(-beyond * t / width - 0.5 * (t / width) ** 2)

        reach = width * min(10, 40 / max(beyond, 1e-9))
        total, square = integral(density, 0, reach, lambda t: t * t)
        square /= total
        assert out[describe.ROWS["log_evidence"], p] == pytest.approx(np.log(2 * total), abs=1e-8)
        expected = np.zeros((5, 5))
        expected[2, 2], expected[4, 4], expected[1, 1] = 4 * square, 0.05**2 + 0.49 * square, 0.01
        expected[2, 4] = expected[4, 2] = -0.7 * 2 * square
        found = out[describe.ROWS["covariance"], p].reshape(5, 5)
        np.testing.assert_allclose(found, expected, rtol=2e-6, atol=0)
        np.testing.assert_allclose(out[describe.ROWS["std"], p], np.sqrt(np.diag(expected)), rtol=1e-6)


def test_near_the_bound_of_the_retardance_the_evidence_loses_the_part_beyond():
    known = scene.scene(Model())
    value, std = np.array([3.1, -3.0, 3.0, 1.0]), np.array([0.1, 0.3, 0.01, 0.1])
    out = rows_of(4, known)
    out[2], out[7], out[cell(2, 2)] = value, std, std**2
    before = out.copy()
    edges.correct_edges(known, out, np.zeros(4, int))
    for p in range(4):
        (inside,) = integral(lambda x, p=p: np.exp(-0.5 * ((x - value[p]) / std[p]) ** 2),
                             max(-pi, value[p] - 12 * std[p]), min(pi, value[p] + 12 * std[p]))  # fmt: skip
        lost = np.log(inside / (std[p] * np.sqrt(2 * pi)))
        assert out[describe.ROWS["log_evidence"], p] == pytest.approx(lost, abs=1e-8)
    np.testing.assert_array_equal(np.delete(out, describe.ROWS["log_evidence"], 0),
                                  np.delete(before, describe.ROWS["log_evidence"], 0))  # fmt: skip
    free = scene.scene(Model(gain=PhaseGain()))
    out = rows_of(4, free)
    out[2], out[7] = value, std
    edges.correct_edges(free, out, np.zeros(4, int))
    assert (out[describe.ROWS["log_evidence"]] == 0).all()  # a circle has no bound


@pytest.mark.parametrize("sign", [-1, 1])
def test_on_the_bound_of_the_diattenuation_moments_and_evidence_are_those_of_the_cut_density(sign):
    known = scene.scene(Model(gain=ComplexGain(1.0)))
    out = rows_of(len(CUTS), known)
    for p, (width, beyond) in enumerate(CUTS):
        out[0, p] = sign
        out[cell(0, 0), p] = width**2  # of the angle delta/2
        out[cell(0, 3), p] = out[cell(3, 0), p] = 0.4
        out[cell(3, 3), p] = 0.05**2
        out[describe.ROWS["slope_0"], p] = beyond / width
    edges.correct_edges(known, out, np.full(len(CUTS), describe.FROZEN[0]))
    for p, (width, beyond) in enumerate(CUTS):
        # delta/2 = pi/4 - t, D = cos 2t
        def density(t, width=width, beyond=beyond):
            return 2 * np.sin(2 * t) * np.exp(-beyond * t / width - 0.5 * (t / width) ** 2)

        reach = min(width * min(10, 45 / max(beyond, 1e-9)), pi / 2)
        total, turn, mixed, square = integral(
            density, 0, reach, lambda t: t * t, lambda t: t * (1 - np.cos(2 * t)), lambda t: (1 - np.cos(2 * t)) ** 2
        )
        assert out[describe.ROWS["log_evidence"], p] == pytest.approx(np.log(total), abs=1e-6)
        expected = np.zeros((5, 5))
        expected[0, 0], expected[3, 3] = square / total, 0.05**2 + 0.16 * turn / total
        expected[0, 3] = expected[3, 0] = 0.4 * mixed / total
        np.testing.assert_allclose(out[describe.ROWS["covariance"], p].reshape(5, 5), expected, rtol=1e-5, atol=0)


def test_near_the_bound_of_the_diattenuation_the_evidence_is_the_integral_over_delta():
    known = scene.scene(Model(gain=ComplexGain(1.0)))
    value, std = np.array([0.99, -0.9, 0.5, 0.999, 0.1]), np.array([0.02, 0.05, 0.3, 1e-4, 0.01])
    out = rows_of(5, known)
    out[0], out[5], out[cell(0, 0)] = value, std, std**2
    edges.correct_edges(known, out, np.zeros(5, int))
    found = out[describe.ROWS["log_evidence"]]
    for p in range(3):
        delta = np.arcsin(value[p])
        width = std[p] / np.cos(delta)
        (total,) = integral(
            lambda x, delta=delta, width=width: np.cos(x) * np.exp(-0.5 * ((x - delta) / width) ** 2),
            max(-pi / 2, delta - 10 * width), min(pi / 2, delta + 10 * width),
        )  # fmt: skip
        assert found[p] == pytest.approx(np.log(total / (np.sqrt(2 * pi) * std[p])), abs=1e-6)
        assert abs(found[p]) > 1e-3
    assert (found[3:] == 0).all()  # too far away to be felt
