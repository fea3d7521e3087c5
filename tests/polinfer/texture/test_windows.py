"""Sums over windows are those of a loop, wherever the window and whatever stands beside it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from polinfer.box_sums import run_sums
from polinfer.texture.windows import Sweep, sweep


@settings(max_examples=60, deadline=None)
@given(
    length=st.integers(0, 20).map(lambda n: 2 * n + 1),
    step=st.integers(1, 4),
    more=st.integers(0, 30),
    seed=st.integers(0, 99),
)
def test_running_sums_are_those_of_a_convolution(length, step, more, seed):
    values = np.random.default_rng(seed).integers(-50, 50, (length - 1) * step + 1 + more)
    kernel = np.zeros((length - 1) * step + 1, int)
    kernel[::step] = 1
    found = run_sums(values, length, step, np.empty((3, len(values)), values.dtype))
    np.testing.assert_array_equal(found, np.convolve(values, kernel, "valid"))


def test_a_sum_keeps_its_digits_beside_a_huge_value():
    values = np.ones(40, np.float32)
    values[20] = 1e20
    found = run_sums(values, 5, 1, np.empty((3, 40), np.float32))
    assert np.all(found[:16] == 5)
    assert np.all(found[21:] == 5)


class _Sum(Sweep):
    features = 2

    def __init__(self, image):
        self.image, self.found = image, np.zeros((2, *image.shape))

    def load(self, rows, out):
        out[0], out[1] = self.image[rows], 1

    def finish(self, rows, sums, spare):
        self.found[:, rows] = sums.reshape(2, rows.stop - rows.start, -1)[..., : self.image.shape[1]]


@pytest.mark.parametrize("shape", [(70, 9), (1, 20), (20, 1), (1, 1), (150, 3)])
@pytest.mark.parametrize("size", [3, 7, 15])
def test_strips_join_without_a_seam(shape, size):
    image = np.random.default_rng(1).integers(0, 9, shape).astype(float)
    job = _Sum(image)
    sweep(job, shape, size, np.dtype(float), None)
    half = size // 2
    wide = np.pad(image, half)
    ones = np.pad(np.ones(shape), half)
    for found, padded in zip(job.found, (wide, ones), strict=True):
        expected = np.lib.stride_tricks.sliding_window_view(padded, (size, size)).sum(axis=(-1, -2))
        np.testing.assert_allclose(found, expected, rtol=1e-13)
