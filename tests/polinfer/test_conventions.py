"""Matrices converted to other packages and back describe the same waves, by formulas written out."""

import sys

import numpy as np
import pytest

from polinfer import Parameters, conventions
from tests.oracles import jones as oracle
from tests.polinfer.published import (
    RNG,
    SHAPES,
    TIME,
    chromatix_matrix,
    katsu_diattenuator,
    katsu_from_jones,
    katsu_retarder,
    moving,
    random_matrices,
    same_up_to_phase,
)

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
