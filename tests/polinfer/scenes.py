"""States, gains, orderings, priors and models that several files of tests share, and how pixels are drawn from them.

Code is compiled for each model, number of states and number of pixels, and for one sigma apart from one for each pixel:
what is shared here is compiled once. ``simulate`` gives each pixel its sigma.
"""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from polinfer import (
    AxialVonMises,
    ComplexGain,
    Measurement,
    Model,
    Ordering,
    Parameters,
    PhaseGain,
    PolariserFirst,
    Prior,
    RetarderFirst,
    TruncatedNormal,
    VonMises,
    fit,
    simulate,
)
from polinfer.elements import multiply, polariser, retarder
from tests.oracles import jones as oracle

FREE = Model()
# a point far from every bound and tie
X = (0.3, 0.5, 1.2, 0.4, 0.7)
BALANCED = np.array([[1, 1, 1], np.exp(2j * np.pi * np.arange(3) / 3)]) / 2**0.5
UNBALANCED = np.array([[1, 0.9, 0.7], [0.1, 0.5j, 0.4 - 0.3j]])
GAINS = {"none": None, "phase": PhaseGain(), "complex": ComplexGain(0.8)}
ORDERINGS = {"retarder_first": RetarderFirst(), "polariser_first": PolariserFirst()}
LIMITS = np.array([1, np.pi / 2, np.pi, np.pi / 2, np.pi])
# none is a default one, and none is the same for two equivalent sets
PRIORS = {
    "diattenuation": TruncatedNormal(0.3, 0.4, -1.0, 1.0),
    "diattenuation_angle": AxialVonMises(0.4, 1.5),
    "retardance": VonMises(1.1, 0.7),
    "retardance_angle": AxialVonMises(-0.9, 0.8),
    "circularity": VonMises(0.5, 2.0),
}


@dataclass(frozen=True)
class Sandwich(Ordering):
    """Half the retarder on either side of the polariser."""

    def jones(self, parameters):
        p = parameters
        half = retarder(p.retardance / 2, p.retardance_angle, p.circularity)
        return multiply(half, multiply(polariser(p.diattenuation, p.diattenuation_angle), half))


def with_priors(**fixed):
    """All priors that are not the default ones, as far as the parameters are free."""
    free = Model(fixed=fixed).free
    return {"priors": {name: prior for name, prior in PRIORS.items() if name in free}, "fixed": fixed}


def uniform(count, seed, diattenuation=0.9):
    """Parameters anywhere in their ranges, |D| up to ``diattenuation``."""
    x = np.random.default_rng(seed).uniform(-1, 1, (5, count)) * LIMITS[:, None]
    x[0] *= diattenuation
    return Parameters(*x)


def drawn(model, count, rng):
    """Parameters from the priors of a model."""
    values = {name: prior.sample(rng, (count,)) for name, prior in model.priors.items()}
    values |= {name: np.full(count, value) for name, value in model.fixed.items()}
    return Parameters(**values)


def everywhere(shape, values):
    """The same parameters in every pixel."""
    return Parameters(*(np.full(shape, value) for value in values))


# pairs of ordering, gain, priors, fixed values and balance of the states
CASES = {
    "free": (FREE, BALANCED),
    "skew states": (Model(PolariserFirst(), gain=ComplexGain(0.8)), UNBALANCED),
    "pure retarder": (Model(PolariserFirst(), **with_priors(diattenuation=0.0)), BALANCED),
    "pure polariser": (Model(gain=ComplexGain(0.8), **with_priors(retardance=0.0)), UNBALANCED),
    "known polariser": (Model(gain=PhaseGain(), **with_priors(diattenuation=0.4)), BALANCED),
}


@cache
def case(name):
    """A model, and 64 pixels with truths from its prior at two noise levels."""
    model, states = CASES[name]
    rng = np.random.default_rng(17)
    data = simulate(model, drawn(model, 64, rng), states, np.where(np.arange(64) % 2, 0.02, 0.2), rng=rng)
    return model, data


@cache
def fitted(name):
    """The fit of a case."""
    return fit(*case(name))


@dataclass(frozen=True)
class Same(Prior):
    """A prior of a user's own that has the density of another one."""

    other: Prior

    def log_density(self, x):
        return self.other.log_density(x)

    def sample(self, rng, shape):
        return self.other.sample(rng, shape)

    @property
    def support(self):
        return self.other.support


def general(model):
    """The same densities by the general route."""
    name = model.free[-1]
    return replace(model, priors=dict(model.priors) | {name: Same(model.priors[name])})


def measured(response, sigma):
    """Responses (*P, 2, 3) to the balanced states, every pixel with its own sigma, as ``simulate`` gives it."""
    return Measurement(BALANCED, response, np.full(response.shape[:-2], sigma))


def oracle_posterior(x, u, v, sigma, gain, ordering):
    """Log posterior of one pixel under the default priors and one of GAINS, by plain NumPy; -inf outside."""
    x = np.array(x, float)
    if gain != "none":
        x[2] = (x[2] + np.pi) % (2 * np.pi) - np.pi
    prior = oracle.log_prior(x)
    if prior == -np.inf:
        return -np.inf
    return prior + oracle.log_marginal(x, u, v, sigma, gain, 0.8, ordering)
