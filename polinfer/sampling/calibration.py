"""Simulation-based calibration: do posteriors hold what they say?"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..checks import as_generator, complex_array, integer, one_of_types, real_number
from ..misalignment import TiltPlane
from ..model import Model
from ..noise import InferredNoise
from ..records import Measurement, Parameters
from ..simulation import simulate
from .ensemble import Ensemble
from .gibbs import Gibbs
from .invariants import invariants
from .verb import sample

__all__ = ["Ranks", "calibration_ranks"]


@dataclass(frozen=True, eq=False)
class Ranks:
    """Ranks of the true values among the draws.

    Attributes
    ----------
    names: of the invariants. ranks: integers ``(invariants, simulations)``, 0 to ``draws``: how many draws are smaller.
    draws: how many there are to each simulation.

    >>> ranks = Ranks(("a",), np.arange(100)[None], 99)
    >>> ranks.p_values(10).tolist(), round(float(ranks.coverage(0.5)[0]), 6)
    ([1.0], 0.5)
    """

    names: tuple[str, ...]
    ranks: np.ndarray
    draws: int

    def p_values(self, bins: int = 20) -> np.ndarray:
        """Of a chi-square test that the ranks are uniform in so many equal bins, for each invariant."""
        from scipy.stats import chisquare  # slow to import

        bins = integer("bins", bins, low=2)
        place = ((self.ranks + 0.5) / (self.draws + 1) * bins).astype(int)
        return np.array([chisquare(np.bincount(row, minlength=bins)).pvalue for row in place])

    def coverage(self, level: float) -> np.ndarray:
        """Share of the simulations whose truth lies in the central interval that holds ``level`` of the posterior.

        A rank among n draws tells the place of the truth to 1 / (n + 1): at the interval's ends it counts in part, so
        that uniform ranks hold ``level`` for any number of draws.
        """
        level = real_number("level", level, above=0, high=1)
        low, high = self.ranks / (self.draws + 1), (self.ranks + 1) / (self.draws + 1)
        inside = np.minimum(high, 0.5 * (1 + level)) - np.maximum(low, 0.5 * (1 - level))
        return np.asarray(np.mean(np.clip(inside * (self.draws + 1), 0, 1), axis=1))


def calibration_ranks(
    model: Model,
    illumination: Any,
    sigma: Any,
    simulations: int,
    sampler: Gibbs | Ensemble | None = None,
    rng: int | np.random.Generator | None = None,
    draws: int = 199,
) -> Ranks:
    """Truths drawn from the priors, data from the truths, and the ranks of the truths among draws of the posterior.

    If model and sampler are right the ranks are uniform (Talts et al., arXiv:1804.06788). They are taken of functions
    that the equivalent parameter sets share (:func:`polinfer.sampling.invariants.invariants`), never of angles.

    Parameters
    ----------
    model: without neighbours; an unknown sigma of every pixel is drawn from its prior too (``sigma`` None).
    illumination: complex ``(2, n)``. sigma: > 0, or None where the model infers it. simulations: >= 1.
    sampler: None: ``Gibbs(thin=4, evidence=False)``. draws: kept for each simulation, far enough apart to be nearly
        independent: of one chain of ``Gibbs``, or spread over what an ensemble gives.

    Raises
    ------
    ValueError: a model with neighbours or one sigma for the frame, numbers out of range. TypeError: wrong kinds.

    >>> from polinfer import RetarderFirst
    >>> states = np.array([[1, 1, 1], np.exp(2j * np.pi * np.arange(3) / 3)]) / 2**0.5
    >>> found = calibration_ranks(Model(), states, 0.1, simulations=64, rng=1, draws=39)
    >>> found.ranks.shape, bool(found.p_values(4).min() > 1e-4)
    ((7, 64), True)
    """
    one_of_types("model", model, (Model,), "pass Model(...).")
    illumination = complex_array("illumination", illumination, trailing=(2, None), finite=True)
    simulations, draws = integer("simulations", simulations, low=1), integer("draws", draws, low=4)
    sampler = Gibbs(thin=4, evidence=False) if sampler is None else sampler
    one_of_types("sampler", sampler, (Gibbs, Ensemble), "pass Gibbs(...) or Ensemble(...).")
    if model.neighbours is not None:
        raise ValueError("model has neighbours; calibrate it without, every simulation is a pixel of its own.")
    if isinstance(model.misalignment, TiltPlane):
        raise ValueError(
            "model has a TiltPlane, which ties all pixels; calibrate it without, every simulation is a pixel."
        )
    generator, seed = as_generator(rng)
    truth = Parameters(
        *(
            model.priors[name].sample(generator, (simulations,))
            if name in model.free
            else np.full(simulations, model.fixed.get(name, 0.0))
            for name in Parameters._fields
        )
    )
    data = simulate(model, truth, illumination, _sigma(model, sigma, simulations, generator), generator)
    if isinstance(model.noise, InferredNoise):
        data = replace(data, sigma=None)
    ranks = _ranks(model, truth, data, sampler, draws, int(generator.integers(1 << 62)) if seed is None else seed)
    return Ranks(tuple(ranks), np.stack(list(ranks.values())), draws)


def _sigma(model: Model, sigma: Any, simulations: int, generator: np.random.Generator) -> Any:
    noise = model.noise
    if not isinstance(noise, InferredNoise):
        return real_number("sigma", sigma, above=0)
    if not noise.integrated:
        raise ValueError("model infers one sigma for the frame, which is no number of a simulation; use scope 'pixel'.")
    if sigma is not None:
        raise ValueError("sigma must be None where the model infers it: it is drawn from its prior.")
    return (noise.scale / generator.gamma(noise.shape, size=simulations)) ** 0.5


def _ranks(
    model: Model, truth: Parameters, data: Measurement, sampler: Gibbs | Ensemble, draws: int, seed: int
) -> dict[str, np.ndarray]:
    if isinstance(sampler, Gibbs):
        found = sample(model, data, sampler, chains=1, draws=draws, rng=seed)
        kept = Parameters(*(x[0] for x in found.parameters))
    else:
        # draws of an ensemble are its walkers in turn
        sampler = replace(sampler, evidence=False)
        found = sample(model, data, sampler, chains=1, draws=max(draws, 2 * sampler.walkers), rng=seed)
        take = np.linspace(0, found.count - 1, draws).astype(int)
        kept = Parameters(*(x[0][take] for x in found.parameters))
    kept = kept._replace(**{name: np.zeros_like(kept.diattenuation) for name in model.dropped})
    true, drawn = invariants(model, truth), invariants(model, kept)
    return {name: np.sum(np.asarray(drawn[name]) < np.asarray(true[name]), axis=0) for name in true}
