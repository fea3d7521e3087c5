"""The power of a comparison: how often the right model is found, by simulation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..checks import as_generator, complex_array, integer, one_of_types, real_array, real_number
from ..fitting import fit
from ..model import Model
from ..noise import InferredNoise
from ..records import Measurement, Parameters
from ..simulation import simulate
from .judgement import judge
from .selection import infer_with
from .units import units_of

__all__ = ["Power", "power"]

PIXELS = 1 << 17  # in memory at once
FEW = 1 << 12  # frames up to this size share compiled code, which takes longer to make than a short study to run


@dataclass(frozen=True)
class Power:
    """How often a comparison finds the truth, of ``simulations`` scenes; ``float()`` of it is ``right``.

    ``right``, ``wrong`` and ``undecided`` are shares that add up to 1; ``error`` is the binomial standard error of
    ``right``. ``advantage`` is the mean log Bayes factor of a scene for the truth (nats), ``seed`` the seed used.

    >>> float(Power(0.75, 0.0, 0.25, 100, 4.1, 1)), Power(0.75, 0.0, 0.25, 100, 4.1, 1).error.__round__(3)
    (0.75, 0.043)
    """

    right: float
    wrong: float
    undecided: float
    simulations: int
    advantage: float
    seed: int | None

    def __float__(self) -> float:
        return self.right

    @property
    def error(self) -> float:
        """Binomial standard error of ``right``."""
        return float(np.sqrt(self.right * (1 - self.right) / self.simulations))


def power(
    model_a: Model,
    model_b: Model,
    illumination: Any,
    sigma: float,
    pixels: int,
    parameters: Parameters,
    simulations: int = 200,
    rng: int | np.random.Generator | None = None,
    infer: Callable[[Model, Measurement], Any] = fit,
) -> Power:
    """Probability that a scene of so many pixels shows which of two models made it, by simulation.

    Scenes are simulated from ``model_a`` and compared as :func:`polinfer.compare` does it: the share whose pooled
    verdict is ``model_a`` is the power; that of ``model_b`` is wrong, the rest undecided. For the other direction
    exchange the models.

    Parameters
    ----------
    model_a: the truth. model_b: the other one. Both without neighbours.
    illumination: complex ``(2, n)``. sigma: > 0, unit of the response.
    pixels: of a scene, >= 1. parameters: of any shape, radians: every pixel of every scene has one of them, drawn at
        random, all equally often.
    simulations: scenes, >= 1. rng: seed, generator or None: a fresh seed, recorded.
    infer: what makes a result with an evidence, as in :func:`polinfer.select`.

    Raises
    ------
    ValueError, TypeError: arguments out of range or of a wrong kind.

    >>> import polinfer
    >>> states = np.array([[1, 1, 1], np.exp(2j * np.pi * np.arange(3) / 3)]) / 2**0.5
    >>> truth = polinfer.Parameters(0.3, 0.4, 1.2, 0.5, 0.2)
    >>> found = power(Model(), Model(polinfer.PolariserFirst()), states, 0.02, 30, truth, simulations=20, rng=1)
    >>> float(found) > 0.8, found.wrong
    (True, 0.0)
    """
    for name, model in (("model_a", model_a), ("model_b", model_b)):
        one_of_types(name, model, (Model,), "pass Model(...).")
        if model.neighbours is not None:
            raise ValueError(f"{name} has {model.neighbours}; give power models without neighbours: its pixels have no "
                             "places.")  # fmt: skip
    illumination = complex_array("illumination", illumination, shape=(2, None), finite=True)
    sigma = real_number("sigma", sigma, above=0)
    pixels, simulations = integer("pixels", pixels, low=1), integer("simulations", simulations, low=1)
    one_of_types("parameters", parameters, (Parameters,), "pass Parameters(...).")
    given = {n: real_array(f"parameters.{n}", getattr(parameters, n), finite=True) for n in model_a.free}
    shape = np.broadcast_shapes(*(x.shape for x in given.values()))
    known = {n: np.broadcast_to(x, shape).reshape(-1) for n, x in given.items()}
    generator, seed = as_generator(rng)
    # one sigma for a frame: every scene is a frame of its own
    by_frame = any(isinstance(m.noise, InferredNoise) and not m.noise.integrated for m in (model_a, model_b))
    together = PIXELS if simulations * pixels > PIXELS else FEW
    block = 1 if by_frame else max(1, together // pixels)
    choices, advantages = [], []
    for begin in range(0, simulations, block):
        size = (min(block, simulations - begin), pixels)
        index = generator.integers(int(np.prod(shape)), size=size)
        zero = dict.fromkeys(Parameters._fields, np.zeros(size))
        truth = Parameters(**(zero | {n: x[index] for n, x in known.items()}))
        data = simulate(model_a, truth, illumination, sigma, rng=generator)
        results = [infer_with(infer, model, data) for model in (model_a, model_b)]
        evidence = np.stack([np.asarray(r.log_evidence, float) for r in results])
        status = np.stack([np.asarray(r.status) for r in results])
        units = units_of([model_a, model_b], evidence, np.zeros_like(evidence), status)
        found = judge(units.values.reshape(2, *size), units.used.reshape(size), np.log([0.5, 0.5]))
        choices.append(found.choice)
        advantages.append(found.pooled[0] - found.pooled[1])
    choice = np.concatenate(choices)
    right, wrong = float(np.mean(choice == 0)), float(np.mean(choice == 1))
    mean = float(np.mean(np.concatenate(advantages)))
    return Power(right, wrong, float(np.mean(choice < 0)), simulations, mean, seed)
