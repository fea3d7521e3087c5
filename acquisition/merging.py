"""One radiance from a bracket of raw frames.

In: raw frames of one view, their exposure times and the rule. Out: radiance with variance and a saturation mask. Called
when a run's raw frames are read.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from acquisition.exposure import MergeRule
from polinfer.checks import integer, one_of_types, real_array
from polinfer.threads import each

__all__ = ["Merged", "merge_exposures", "merge_views"]

PIXELS = 1 << 18  # merged at a time


@dataclass(frozen=True)
class Merged:
    """radiance: float32 (y, x), photo-electrons per second. variance: its variance, infinite where saturated at every
    exposure. saturated: bool (y, x), such pixels; their radiance is only a lower bound. Of several views: (view, y, x).
    """

    radiance: np.ndarray
    variance: np.ndarray
    saturated: np.ndarray


def merge_exposures(frames: Any, exposures: Any, full_scale: int, rule: MergeRule) -> Merged:
    """One radiance image from a bracket of raw frames.

    Parameters
    ----------
    frames: integer counts (k, y, x). exposures: (k,) seconds, > 0. full_scale: the count at which a pixel saturates
    (255 for 8 bits); counts >= full_scale are not used. rule: ``InverseVariance(...)`` or ``LongestUnsaturated(...)``.

    Raises
    ------
    TypeError: frames are not integers, or another rule. ValueError: shapes, exposure times, counts above full scale.

    >>> from acquisition import InverseVariance
    >>> frames = np.array([[[255, 40]], [[100, 20]]], np.uint8)
    >>> merged = merge_exposures(frames, [0.2, 0.1], 255, InverseVariance(gain=2.0, read_noise=1.0))
    >>> merged.radiance.round(1).tolist()
    [[2000.0, 400.0]]
    """
    frames = np.asarray(frames)
    whole = _empty(frames.shape[1:])
    _merge_into(whole, frames, exposures, full_scale, rule)
    return whole


def _empty(shape: tuple[int, ...]) -> Merged:
    return Merged(np.empty(shape, np.float32), np.empty(shape, np.float32), np.empty(shape, bool))


def _merge_into(out: Merged, frames: np.ndarray, exposures: Any, full_scale: int, rule: MergeRule) -> None:
    """:func:`merge_exposures` into arrays that are there, some rows at a time, which stay in the processor's cache."""
    one_of_types("rule", rule, (MergeRule,), "pass InverseVariance(...) or LongestUnsaturated(...).")
    if frames.dtype.kind not in "ui":
        raise TypeError(f"frames must be raw integer counts, got {frames.dtype}; do not scale them.")
    if frames.ndim != 3 or len(frames) == 0:
        raise ValueError(f"frames must have shape (k, y, x) with k >= 1, got {frames.shape}.")
    times = real_array("exposures", exposures, shape=(len(frames),), above=0, finite=True)
    full_scale = integer("full_scale", full_scale, low=1)
    if frames.min() < 0 or frames.max() > full_scale:
        raise ValueError(
            f"frames must hold counts from 0 to full_scale {full_scale}, got {frames.min()} to {frames.max()}."
        )
    if np.any(np.diff(times) > 0):
        longest_first = np.argsort(-times, kind="stable")
        frames, times = frames[longest_first], times[longest_first]
    if frames.shape[1:] != out.radiance.shape:
        raise ValueError(f"frames must all have one size, got {frames.shape[1:]} beside {out.radiance.shape}.")
    height, width = frames.shape[1:]
    for rows in np.array_split(np.arange(height), max(1, -(-height * width // PIXELS))):
        own = slice(rows[0], rows[-1] + 1) if len(rows) else slice(0)
        parts = _merged(frames[:, own], times, full_scale, rule)
        out.radiance[own], out.variance[own], out.saturated[own] = (np.asarray(part) for part in parts)


def merge_views(frames: Sequence[Any], exposures: Sequence[Any], full_scale: int, rule: MergeRule) -> Merged:
    """:func:`merge_exposures` of every view of a capture, on all cores: arrays (view, y, x)."""
    whole = _empty((len(frames), *np.shape(frames[0])[1:]))

    def one(view: int) -> None:
        own = Merged(whole.radiance[view], whole.variance[view], whole.saturated[view])
        _merge_into(own, np.asarray(frames[view]), exposures[view], full_scale, rule)

    each(one, range(len(frames)))
    return whole


@partial(jax.jit, static_argnames="rule")
def _merged(frames: Any, times: Any, full_scale: Any, rule: MergeRule) -> tuple[Any, Any, Any]:
    """Radiance, variance and saturation in one pass over the pixels; frames from the longest exposure down.

    In single precision: 1e-7 of a radiance whose noise is a hundredth of it at best.
    """
    times = times.astype(jnp.float32)
    gain, dark, offset = rule.conversion
    count = len(frames)
    usable = [frame < full_scale for frame in frames]
    rates = [(frame.astype(jnp.float32) - offset) * (gain / t) - dark for frame, t in zip(frames, times, strict=True)]
    estimate, saturated = rates[-1], ~usable[-1]
    for k in range(count - 2, -1, -1):
        estimate = jnp.where(usable[k], rates[k], estimate)
        saturated &= ~usable[k]
    first = rule.weight(times[0], estimate)
    if first is None:
        radiance, variance = estimate, jnp.full(estimate.shape, jnp.inf)
        for k in range(count - 1, -1, -1):
            variance = jnp.where(usable[k], rule.variance(times[k], estimate), variance)
        return radiance, variance, saturated
    # one exposure after the other, so that a pixel never leaves the processor's registers
    weights = [jnp.where(usable[k], rule.weight(times[k], estimate), 0) for k in range(count)]
    total = sum(weights[1:], start=weights[0])
    scale = 1 / jnp.where(saturated, 1, total)
    # the rates themselves are used unclipped: a negative one (below the dark level) is a fair noisy value
    mean = sum((w * r for w, r in zip(weights[1:], rates[1:], strict=True)), start=weights[0] * rates[0]) * scale
    radiance = jnp.where(saturated, estimate, mean)
    parts = [(w * scale) ** 2 * rule.variance(t, radiance) for w, t in zip(weights, times, strict=True)]
    variance = sum(parts[1:], start=parts[0])
    return radiance, jnp.where(saturated, jnp.inf, variance), saturated
