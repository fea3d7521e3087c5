"""The one-dimensional steps of the sweep against distribution functions of other making."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chisquare, kstest, norm, vonmises
from scipy.stats import gamma as gamma_distribution

from polinfer.sampling.gibbs import circle
from polinfer.sampling.gibbs.random import WEYL, Random, begin, word

LANES, STEPS = 4000, 40
LEAST = 1e-4  # probability below which a test of a fixed seed objects


def run(step, given, start, dtype, seed, steps=STEPS):
    """The last of so many steps of every lane, all begun at one place; ``given``: what the density depends on.

    Code is compiled for a step and a precision; the densities are its arguments.
    """
    full = partial(jnp.full, (1, LANES), dtype=dtype)
    given = [full(x) if np.ndim(x) == 0 else jnp.asarray(x, dtype) for x in given]
    last = _advance(step, dtype, given, jax.tree.map(full, start), begin(seed, np.arange(LANES), 1), steps)
    return jax.tree.map(lambda x: np.asarray(x, float)[0], last)


@partial(jax.jit, static_argnums=(0, 1))
def _advance(step, dtype, given, first, stream, steps):
    def one(_, carry):
        stream, old = carry
        random = Random(stream, dtype)
        new = step(random, *given, old)
        return random.stream, new

    return jax.lax.fori_loop(0, steps, one, (stream, first))[1]


def angles(pair):
    assert np.abs(np.hypot(*pair) - 1).max() < 1e-5
    return np.arctan2(pair[1], pair[0])


def numerical(log_density, low, high):
    """Distribution function of a density on an interval, by the trapezoidal rule."""
    grid = np.linspace(low, high, 200_001)
    density = np.exp(log_density(grid) - np.max(log_density(grid)))
    total = np.concatenate([[0], np.cumsum(0.5 * (density[1:] + density[:-1]))])
    return lambda x: np.interp(x, grid, total / total[-1])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("concentration", [0.0, 0.3, 3.0, 400.0, 1e8])
def test_von_mises(dtype, concentration):
    given = [concentration * x for x in (np.cos(2.0), np.sin(2.0))]
    found = angles(run(circle.von_mises, given, (1.0, 0.0), dtype, 1))
    # about the mean: a single precision angle near 2 is known to 1e-7 only, a tenth of a percent of the width at 1e8
    off = np.remainder(found - 2.0 + np.pi, 2 * np.pi) - np.pi
    if concentration == 0:
        assert kstest(off, "uniform", (-np.pi, 2 * np.pi)).pvalue > LEAST
    elif concentration > 1e6:
        assert kstest(off * concentration**0.5, norm.cdf).pvalue > LEAST
    else:
        assert kstest(off, vonmises(concentration).cdf).pvalue > LEAST


@pytest.mark.parametrize(("b", "c"), [(0.0, 0.0), (3.0, 2.0), (-3.0, 5.0), (-0.5, -0.3), (-40.0, 900.0), (200.0, -1e4)])
def test_half_circle(b, c):
    found = angles(run(circle.half_circle, (b, c), (1.0, 0.0), float, 2))
    cdf = numerical(lambda y: b * np.cos(y) + c * np.sin(y), -np.pi / 2, np.pi / 2)
    assert kstest(found, cdf).pvalue > LEAST


CASES = [
    (0.0, 0.0, 0.0, 0.0), (5.0, 1.0, 0.3, 4.0), (900.0, 100.0, 0.0, 4.0), (800.0, 780.0, 0.0, 4.0),
    (500.0, 900.0, 0.0, 4.0), (-3.0, 1.0, 2.0, 0.0), (50.0, -45.0, -6.0, 25.0),
    (1000.0, -900.0, 350.0, 0.0), (1000.0, 400.0, -350.0, 4.0), (3000.0, -2000.0, 1200.0, 0.0),
]  # fmt: skip


@pytest.mark.parametrize(("b", "c", "linear", "square"), CASES)
def test_diattenuation(b, c, linear, square):
    # it takes a while to come from far away
    found = angles(run(circle.diattenuation, (b, c, linear, square), (1.0, 0.0), float, 3, 200))

    def log_density(y):
        d = np.sin(2 * y)
        with np.errstate(divide="ignore"):
            edge = np.log(np.maximum(np.cos(2 * y), 0))
        return b * np.cos(y) + c * np.sin(y) + linear * d - 0.5 * square * d * d + edge

    assert kstest(found, numerical(log_density, -np.pi / 4, np.pi / 4)).pvalue > LEAST


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("size", [1e2, 1e4, 1e6])
def test_most_candidates_of_the_diattenuation_are_taken_where_its_linear_part_is_large(size, dtype):
    # the log likelihood -|Y - J R|^2 of data without noise, light of power ``size`` and Stokes parameter ``-linear``
    rng = np.random.default_rng(2)
    y, stokes = rng.uniform(-0.6, 0.6, (1, LANES)), size * rng.uniform(-0.9, 0.9, (1, LANES))
    along, across = 2 * (size + stokes * np.sin(2 * y)), 2 * stokes * np.cos(2 * y)
    b, c, linear = along * np.cos(y) - across * np.sin(y), along * np.sin(y) + across * np.cos(y), -stokes
    given = b, c, linear, np.zeros_like(b)
    last = [run(circle.diattenuation, given, (1.0, 0.0), dtype, 6, steps) for steps in (30, 31)]
    assert np.mean(last[0][1] != last[1][1]) > 0.6


TWO = [
    (0.0, 0.0, 0.0, 0.0), (3.0, 1.0, 0.5, 0.2), (30.0, -40.0, 12.0, 9.0), (-400.0, 100.0, 120.0, 10.0),
    (0.5, 0.0, 1.5, 0.0), (2.0, 0.0, -2.0, 0.0), (1e4, 3e3, -2e3, 1e3), (0.1, 0.4, 0.2, -1.0),
]  # fmt: skip


def _two_harmonics(random, b, c, d, e, old):
    return circle.two_harmonics(random, (b, c), (d, e), old)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(("b", "c", "d", "e"), TWO)
def test_two_harmonics(b, c, d, e, dtype):
    found = angles(run(_two_harmonics, (b, c, d, e), (1.0, 0.0), dtype, 7, 200))
    cdf = numerical(lambda y: b * np.cos(y) + c * np.sin(y) + d * np.cos(2 * y) + e * np.sin(2 * y), -np.pi, np.pi)
    assert kstest(found, cdf).pvalue > LEAST


def test_slices_of_a_density_with_two_peaks():
    def log_density(pair):
        double = pair[0] ** 2 - pair[1] ** 2
        return 1.5 * double + 0.5 * pair[1]

    def step(random, old):
        return circle.slice_step(random, log_density, 4.0, old)

    found = angles(run(step, (), (1.0, 0.0), float, 4))
    cdf = numerical(lambda y: 1.5 * np.cos(2 * y) + 0.5 * np.sin(y), -np.pi, np.pi)
    assert kstest(found, cdf).pvalue > LEAST


@pytest.mark.parametrize("shape", [1.0, 4.5, 3000.0])
def test_gamma(shape):
    found = run(Random.gamma, (shape,), shape, float, 5)
    assert kstest(found, gamma_distribution(shape).cdf).pvalue > LEAST


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_words_are_uniform_and_lanes_unrelated(dtype):
    stream, rows = jax.tree.map(jnp.asarray, begin(9, np.arange(LANES), 1)), []
    for _ in range(8):
        random = Random(stream, dtype)
        rows.append(np.asarray(random.uniform(), float)[0])
        stream = random.stream
    values = np.stack(rows)
    assert 0 < values.min() < values.max() < 1
    assert kstest(values.ravel(), "uniform").pvalue > LEAST
    correlation = np.corrcoef(values) - np.eye(8)
    assert np.abs(correlation).max() < 5 / LANES**0.5
    assert abs(np.corrcoef(values[:, :-1].ravel(), values[:, 1:].ravel())[0, 1]) < 5 / (8 * LANES) ** 0.5


def test_no_bit_no_pair_of_words_and_no_two_lanes_with_near_keys_are_related():
    keys = np.arange(256, dtype=np.uint32)  # next to each other: the worst that can be
    count = 4096

    for first, second in ((keys, 0 * keys), (0 * keys, keys), (keys * WEYL, keys)):
        words = np.asarray(word((first, second, np.arange(count, dtype=np.uint32)[:, None])))  # (words, lanes)
        bits = np.unpackbits(words.T.copy().view(np.uint8), axis=1).reshape(len(keys), count, 32).astype(np.float32)
        signs = 2 * bits - 1
        total = signs.size / 32
        assert np.abs(signs.sum(axis=(0, 1))).max() < 4.5 * total**0.5  # 32 numbers
        # with the next word and with the same one of the next lane, bit by bit: 1024 pairs each
        flat = signs.reshape(-1, 32)
        for other in (np.roll(signs, 1, axis=1), np.roll(signs, 1, axis=0)):
            assert np.abs(flat.T @ other.reshape(-1, 32)).max() < 5.5 * total**0.5
        # and as points of a square of 64 x 64 cells
        for other in (np.roll(words, 1, axis=0), np.roll(words, 1, axis=1)):
            cells = np.bincount(((words >> 26) * 64 + (other >> 26)).ravel(), minlength=4096)
            assert chisquare(cells).pvalue > LEAST


def test_streams_depend_on_seed_pixel_chain_and_purpose_only():
    whole, part = begin(3, np.arange(10), 2), begin(3, np.array([4, 7]), 2)
    for a, b in zip(whole[:2], part[:2], strict=True):
        np.testing.assert_array_equal(a[:, [4, 7]], b)
    assert len(np.unique(whole[0])) == 20
    for other in (begin(4, np.arange(10), 2), begin(3, np.arange(10), 2, purpose=1)):
        assert not np.any(whole[0] == other[0])
