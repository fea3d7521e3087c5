"""What the sweep must know of a model, decided once, outside compiled code."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from math import asin, cos, pi, sin
from typing import Any

import jax
import jax.numpy as jnp

from ...fitting.fast.point import Pair
from ...fitting.fast.priors import COPIES, FACTORS, Flat, Harmonic, Normal, Term, term
from ...fitting.fast.scene import BOUNDS
from ...gain import ComplexGain, PhaseGain
from ...model import Model
from ...noise import InferredNoise, KnownNoise
from ...orderings import PolariserFirst, RetarderFirst
from ...priors import Prior
from ...records import Parameters

__all__ = ["Any1D", "Plan", "plan"]

# the three exchanges that make the eight copies, by their place in COPIES
GENERATORS = (COPIES[1], COPIES[2], COPIES[4])


@dataclass(frozen=True)
class Any1D:
    """Any prior of one parameter as a function of its angle y, seen from a copy ``y -> sign y + shift``."""

    prior: Prior
    name: str
    period: float
    sign: int = 1
    shift: float = 0.0

    def transformed(self, sign: int, shift: float) -> Any1D:
        """The same density seen from a copy."""
        return replace(self, sign=self.sign * sign, shift=self.shift + self.sign * shift)

    def evaluate(self, pair: Pair) -> tuple[Any]:
        """Log density."""
        c, s = pair
        if self.name == "diattenuation":
            value = self.sign * 2 * s * c
        else:
            y = self.sign * jnp.arctan2(s, c) + self.shift
            value = y / getattr(FACTORS, self.name)
            value = value - self.period * jnp.ceil(value / self.period - 0.5)
        low, high = self.prior.support
        inside = (value >= low) & (value <= high)
        return (jnp.where(inside, self.prior.log_density(value), -jnp.inf),)


Shape = Term | Any1D


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["gain_precision", "shape", "scale"],
    meta_fields=["retarder_first", "gain", "noise", "prior", "free", "fixed", "exchanges", "bounded"],
)
@dataclass(frozen=True)
class Plan:
    """A model in the form in which the sweep evaluates it.

    ``free`` are the angles that move, ``fixed`` (cosine, sine) of the others. ``gain`` is "unit", "phase" or "complex"
    with ``gain_precision`` 1/t^2; ``noise`` "known", "pixel" or "frame" with the inverse gamma's ``shape`` and
    ``scale``. ``exchanges`` are those of the three exchanges of equivalent sets that change the prior, with the prior
    as it is behind them. ``bounded``: the retardance ends at -pi and pi. Code is compiled for all but the numbers of
    gain and noise, which are its arguments.
    """

    retarder_first: bool
    gain: str
    gain_precision: Any
    noise: str
    shape: Any
    scale: Any
    prior: tuple[Shape | None, ...]
    free: tuple[int, ...]
    fixed: tuple[tuple[float, float] | None, ...]
    exchanges: tuple[tuple[Any, tuple[Shape | None, ...]], ...]
    bounded: bool


def plan(model: Model) -> Plan | str:
    """The plan of a model, or why there is none."""
    if type(model.ordering) not in (RetarderFirst, PolariserFirst):
        return f"the conditionals of the ordering {type(model.ordering).__name__} are not known"
    if model.gain is not None and type(model.gain) not in (PhaseGain, ComplexGain):
        return f"the conditional of the gain {type(model.gain).__name__} is not known"
    if type(model.noise) not in (KnownNoise, InferredNoise):
        return f"the conditional of the noise {type(model.noise).__name__} is not known"
    if model.neighbours is not None and model.gain is not None:
        return "a window whose pixels have a gain each has no statistics of fixed size"
    prior: list[Shape | None] = []
    fixed: list[tuple[float, float] | None] = []
    for name, factor in zip(Parameters._fields, FACTORS, strict=True):
        if name in model.free:
            own = model.priors[name]
            # a prior that is cut off within the range has no harmonic form
            whole = model.bounds.get(name, BOUNDS.get(name)) == BOUNDS.get(name)
            prior.append((term(name, own) if whole else None) or Any1D(own, name, _period(name)))
            fixed.append(None)
            continue
        prior.append(None)
        value = model.fixed.get(name, 0.0)
        angle = 0.5 * asin(value) if name == "diattenuation" else factor * value
        fixed.append((cos(angle), sin(angle)))
    free = tuple(i for i, one in enumerate(fixed) if one is None)
    exchanges = []
    for copy in GENERATORS:
        # an exchange needs every angle that it moves to be free
        moves = [i for i, move in enumerate(copy) if move != (1, 0.0)]
        behind = tuple(None if t is None else t.transformed(*m) for t, m in zip(prior, copy, strict=True))
        if all(i in free for i in moves) and behind != tuple(prior):
            exchanges.append((copy, behind))
    noise = model.noise if isinstance(model.noise, InferredNoise) else None
    gain = "unit" if model.gain is None else "phase" if isinstance(model.gain, PhaseGain) else "complex"
    return Plan(
        retarder_first=type(model.ordering) is RetarderFirst,
        gain=gain,
        gain_precision=1 / model.gain.scale**2 if isinstance(model.gain, ComplexGain) else 0.0,
        noise="known" if noise is None else noise.scope,
        shape=0.0 if noise is None else noise.shape,
        scale=0.0 if noise is None else noise.scale,
        prior=tuple(prior),
        free=free,
        fixed=tuple(fixed),
        exchanges=tuple(exchanges),
        bounded=gain == "unit",
    )


def _period(name: str) -> float:
    return 2 * pi if name in ("retardance", "circularity") else pi


def conjugate(own: Shape | None) -> tuple[float, float, float, float] | None:
    """What a prior adds to the coefficients of cos y, sin y, cos 2y and sin 2y; None: it has another form."""
    if own is None or isinstance(own, Flat):
        return 0.0, 0.0, 0.0, 0.0
    if isinstance(own, Harmonic) and own.order <= 2:
        pair = own.strength * cos(own.phase), own.strength * sin(own.phase)
        return (*pair, 0.0, 0.0) if own.order == 1 else (0.0, 0.0, *pair)
    return None


def normal(own: Shape | None) -> tuple[float, float] | None:
    """What a prior of D adds linearly and as half a square; None: it is neither flat nor normal."""
    if own is None or isinstance(own, Flat):
        return 0.0, 0.0
    if isinstance(own, Normal):
        return own.mean / own.scale**2, 1 / own.scale**2
    return None
