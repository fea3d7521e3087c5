"""Conversions against the packages themselves, where they are installed."""

import os
import subprocess
import sys
import warnings

import numpy as np
import pytest

import polinfer
from polinfer import Parameters, PolariserFirst, RetarderFirst, conventions
from tests.oracles import jones as oracle
from tests.polinfer.published import (
    EDGES,
    LINEAR,
    SHAPES,
    py_pol_retarder_linear,
    pypolar_retarder,
    random_matrices,
    same_up_to_phase,
)


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
