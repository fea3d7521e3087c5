"""Random numbers of many lanes at once: every pixel and chain has a stream of its own, whatever else is sampled.

The generator is xoshiro128+ (Blackman and Vigna, ACM Trans. Math. Softw. 47, 36, 2021), four 32-bit words a lane, of
which the upper bits are used; streams are begun by SplitMix64 from the seed, the pixel and the chain. JAX's own
generators, counters that are scrambled anew for every number, take longer than all the rest of a sweep.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .circle import quarter_sine

__all__ = ["Random", "Stream", "begin", "gamma", "normals", "signed", "uniform", "word"]

Stream = tuple[Any, Any, Any, Any]
GOLDEN = np.uint64(0x9E3779B97F4A7C15)
ATTEMPTS = 3  # at a gamma variate, each of which succeeds with probability 0.95 or more


def _scramble(x: np.ndarray) -> np.ndarray:
    with np.errstate(over="ignore"):
        x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


def begin(seed: int, pixels: np.ndarray, chains: int, purpose: int = 0) -> Stream:
    """Streams of pixels with the numbers ``pixels``, each word ``(chains, pixels)`` uint32.

    >>> a, b = begin(1, np.array([3, 7]), 2), begin(1, np.array([7]), 2)
    >>> bool((a[0][:, 1] == b[0][:, 0]).all()), len({*a[0].ravel().tolist()})
    (True, 4)
    """
    root = np.random.SeedSequence([seed, purpose]).generate_state(1, np.uint64)[0]
    with np.errstate(over="ignore"):
        lane = _scramble(root + GOLDEN * (np.asarray(pixels).astype(np.uint64)[None] + np.uint64(1)))
        lane = _scramble(lane + GOLDEN * (np.arange(chains, dtype=np.uint64)[:, None] + np.uint64(1)))
        first, second = _scramble(lane + GOLDEN), _scramble(lane + GOLDEN + GOLDEN)
    low = np.uint64(0xFFFFFFFF)
    words = (first & low, first >> np.uint64(32), second & low, second >> np.uint64(32))
    a, b, c, d = (w.astype(np.uint32) for w in words)
    return np.where((a | b | c | d) == 0, np.uint32(1), a), b, c, d


def word(stream: Stream) -> tuple[Stream, Any]:
    """The next 32 bits of every lane."""
    a, b, c, d = stream
    result = a + d
    shifted = b << 9
    c, d = c ^ a, d ^ b
    b, a = b ^ c, a ^ d
    c = c ^ shifted
    return (a, b, c, (d << 11) | (d >> 21)), result


def uniform(stream: Stream, dtype: Any) -> tuple[Stream, Any]:
    """In (0, 1), never 0 nor 1."""
    stream, bits = word(stream)
    if np.dtype(dtype) == np.float32:
        return stream, ((bits >> 9).astype(dtype) + dtype(0.5)) * dtype(2.0**-23)
    return stream, (bits.astype(dtype) + dtype(0.5)) * dtype(2.0**-32)


def signed(stream: Stream, dtype: Any) -> tuple[Stream, Any]:
    """In [-1, 1]."""
    stream, bits = word(stream)
    return stream, jax.lax.bitcast_convert_type(bits, jnp.int32).astype(dtype) * dtype(2.0**-31)


def normals(stream: Stream, dtype: Any) -> tuple[Stream, Any, Any]:
    """Two independent standard normal variates (Box and Muller)."""
    stream, first = uniform(stream, dtype)
    stream, second = signed(stream, dtype)
    radius = jnp.sqrt(-2 * jnp.log(first))
    sine, cosine = quarter_sine(second), quarter_sine(1 - jnp.abs(second))
    return stream, radius * (cosine * cosine - sine * sine), radius * 2 * sine * cosine


def gamma(stream: Stream, shape: Any, old: Any) -> tuple[Stream, Any]:
    """Gamma variates of scale 1 and ``shape >= 1`` (Marsaglia and Tsang), ``old`` where all attempts fail.

    Whether they fail does not depend on ``old``, so a distribution that ``old`` has remains.
    """
    dtype = old.dtype.type
    d = shape - dtype(1 / 3)
    c = 1 / jnp.sqrt(9 * d)
    found, result = jnp.zeros(old.shape, bool), old
    for _ in range(ATTEMPTS):
        stream, x, _ = normals(stream, dtype)
        stream, u = uniform(stream, dtype)
        base = jnp.maximum(1 + c * x, 0)
        v = base * base * base
        ok = (base > 0) & (jnp.log(u) < 0.5 * x * x + d * (1 - v + jnp.log(jnp.where(base > 0, v, 1))))
        result = jnp.where(ok & ~found, d * v, result)
        found = found | ok
    return stream, result


class Random:
    """The streams of a step while it is traced: each call advances them."""

    def __init__(self, stream: Stream, dtype: Any) -> None:
        self.stream, self.dtype = stream, np.dtype(dtype).type

    def uniform(self) -> Any:
        """In (0, 1)."""
        self.stream, x = uniform(self.stream, self.dtype)
        return x

    def signed(self) -> Any:
        """In [-1, 1]."""
        self.stream, x = signed(self.stream, self.dtype)
        return x

    def normals(self) -> tuple[Any, Any]:
        """Two independent standard normal variates."""
        self.stream, x, y = normals(self.stream, self.dtype)
        return x, y

    def gamma(self, shape: Any, old: Any) -> Any:
        """Gamma variates, see :func:`gamma`."""
        self.stream, x = gamma(self.stream, shape, old)
        return x
