"""Random numbers of many lanes at once: every pixel and chain has a stream of its own, whatever else is sampled.

The n-th 32-bit word of a lane is a hash of n and of the lane's two keys: Weyl's sequence of one key, scrambled by a
multiplication, the other key added, and then Wellons' "triple32", three multiplications with the least known bias of
their kind. The keys come from SplitMix64 of the seed, the pixel and the chain. A word needs none before it: in a
generator with a state the compiler computes the whole chain of states anew for every few numbers, which takes longer
than all the rest of a sweep; so do JAX's own, made for cryptography. A lane repeats itself after 2^32 words.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .circle import quarter_sine

__all__ = ["Random", "Stream", "begin", "word"]

Stream = tuple[Any, Any, Any]  # two keys, (chains, pixels), and how many words have been drawn
GOLDEN, WEYL = np.uint64(0x9E3779B97F4A7C15), np.uint32(0x9E3779B9)
ATTEMPTS = 3  # at a gamma variate, each of which succeeds with probability 0.95 or more


def _scramble(x: np.ndarray) -> np.ndarray:
    with np.errstate(over="ignore"):
        x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


def begin(seed: int, pixels: np.ndarray, chains: int, purpose: int = 0) -> Stream:
    """Streams of pixels with the numbers ``pixels``: keys ``(chains, pixels)`` uint32, and no word drawn yet.

    >>> a, b = begin(1, np.array([3, 7]), 2), begin(1, np.array([7]), 2)
    >>> bool((a[0][:, 1] == b[0][:, 0]).all()), len({*a[0].ravel().tolist()})
    (True, 4)
    """
    root = np.random.SeedSequence([seed, purpose]).generate_state(1, np.uint64)[0]
    with np.errstate(over="ignore"):
        lane = _scramble(root + GOLDEN * (np.asarray(pixels).astype(np.uint64)[None] + np.uint64(1)))
        lane = _scramble(lane + GOLDEN * (np.arange(chains, dtype=np.uint64)[:, None] + np.uint64(1)))
    return (lane & np.uint64(0xFFFFFFFF)).astype(np.uint32), (lane >> np.uint64(32)).astype(np.uint32), np.uint32(0)


def word(stream: Stream, number: int = 0) -> Any:
    """32 bits of every lane: the word ``number`` after those that have been drawn."""
    first, second, drawn = stream
    x = first + (drawn + np.uint32(number)) * WEYL
    x = (x ^ (x >> 16)) * np.uint32(0x21F0AAAD)
    x = (x ^ (x >> 15)) + second
    x = (x ^ (x >> 17)) * np.uint32(0xED5AD4BB)
    x = (x ^ (x >> 11)) * np.uint32(0xAC4C1B51)
    x = (x ^ (x >> 15)) * np.uint32(0x31848BAB)
    return x ^ (x >> 14)


class Random:
    """The streams of a step while it is traced: each call takes the next word or words.

    ``one`` is 1, which the compiler does not know: what is divided by it is not computed anew for each of its uses.
    """

    def __init__(self, stream: Stream, dtype: Any, one: Any = None) -> None:
        self.begun, self.dtype, self.number, self.one = stream, np.dtype(dtype).type, 0, one

    def kept(self, values: Any) -> Any:
        """The same values, each computed once."""
        return values if self.one is None else jax.tree.map(lambda x: x / self.one, values)

    @property
    def stream(self) -> Stream:
        """What the next step begins with."""
        first, second, drawn = self.begun
        return first, second, drawn + np.uint32(self.number)

    def word(self) -> Any:
        """32 bits."""
        self.number += 1
        return word(self.begun, self.number - 1)

    def uniform(self) -> Any:
        """In (0, 1), never 0 nor 1."""
        bits, dtype = self.word(), self.dtype
        if dtype is np.float32:
            return ((bits >> 9).astype(dtype) + dtype(0.5)) * dtype(2.0**-23)
        return (bits.astype(dtype) + dtype(0.5)) * dtype(2.0**-32)

    def signed(self) -> Any:
        """In [-1, 1]."""
        return jax.lax.bitcast_convert_type(self.word(), jnp.int32).astype(self.dtype) * self.dtype(2.0**-31)

    def normals(self) -> tuple[Any, Any]:
        """Two independent standard normal variates (Box and Muller)."""
        first, second = self.uniform(), self.signed()
        radius = jnp.sqrt(-2 * jnp.log(first))
        sine, cosine = quarter_sine(second), quarter_sine(1 - jnp.abs(second))
        return radius * (cosine * cosine - sine * sine), radius * 2 * sine * cosine

    def gamma(self, shape: Any, old: Any) -> Any:
        """Gamma variates of scale 1 and ``shape >= 1`` (Marsaglia and Tsang), ``old`` where all attempts fail.

        Whether they fail does not depend on ``old``, so a distribution that ``old`` has remains.
        """
        dtype = old.dtype.type
        d = shape - dtype(1 / 3)
        c = 1 / jnp.sqrt(9 * d)
        found, result = jnp.zeros(old.shape, bool), old
        for _ in range(ATTEMPTS):
            x, _ = self.normals()
            u = self.uniform()
            base = jnp.maximum(1 + c * x, 0)
            v = base * base * base
            ok = (base > 0) & (jnp.log(u) < 0.5 * x * x + d * (1 - v + jnp.log(jnp.where(base > 0, v, 1))))
            result = jnp.where(ok & ~found, d * v, result)
            found = found | ok
        return result
