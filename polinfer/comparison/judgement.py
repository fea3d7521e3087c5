"""When a model is found: the rule by which evidences of many pixels become one verdict.

The Bayes factor of a scene is the product of those of its pixels, right as long as the priors describe the scene, as
if every pixel had drawn its parameters from them. They seldom do, and where models overlap it matters. Both orderings
contain every matrix without diattenuation. With |D| below its noise and a much wider prior of D, the noise alone makes
the two log evidences of a pixel differ by about half a nat either way, and a sum over 972 pixels scatters by 10 to 15
nats though no pixel knows anything. Products of Bayes factors are then sure of either answer, equally often.

So a verdict asks for two things: a probability of at least 0.95, and a sum of differences that stands out of the
scatter of its terms by 1.96 standard deviations,

    S = sum_i d_i >= 1.96 sqrt(n / (n - 1) sum_i (d_i - S / n)^2),   d_i = log evidence (best) - log evidence (other),

against every other model. Of scenes in which two models are equally good, one in twenty then gets a verdict. This is
Vuong's test for models that overlap, beside the Bayes factor and not instead of it.

What the rule cannot see is a bias. With balanced states the orderings are mirror images (J and its transpose), and
where D = 0 their evidences do not differ on average. With unbalanced ones a wide prior of D leaves them different
volumes: 0.06 nat a pixel at a condition number of 5, 60 nats for a scene that knows nothing. So offer a model without
diattenuation beside the two orderings, ``Model(fixed={"diattenuation": 0.0})``: it is what they have in common, and it
wins where D is within its noise, by far more than that. Or look at :func:`polinfer.comparison.ordering_screen`, which
has no prior.

Source: Q. H. Vuong, Econometrica 57, 307 (1989).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

__all__ = ["CERTAIN", "OUTSTANDING", "UNDECIDED", "Judgement", "judge", "probabilities"]

CERTAIN = 0.95
OUTSTANDING = 1.959963984540054  # two-sided 5 % of a normal distribution
UNDECIDED = "undecided"


class Judgement(NamedTuple):
    """Of each scene: ``pooled``, ``probability``, ``scatter`` (model, scenes) and ``choice`` (scenes), -1: undecided.

    ``scatter`` is the standard deviation of the pooled difference from the best model, from the spread of its terms;
    0 for the best model itself, NaN where there is only one term.
    """

    pooled: np.ndarray
    probability: np.ndarray
    scatter: np.ndarray
    choice: np.ndarray


def probabilities(log_evidence: np.ndarray, log_prior: np.ndarray) -> np.ndarray:
    """Posterior probabilities of models along axis 0; NaN where an evidence is not known.

    >>> probabilities(np.array([0.0, -1.0]), np.log([0.5, 0.5])).round(3).tolist()
    [0.731, 0.269]
    """
    posterior = log_evidence + log_prior.reshape(-1, *(1,) * (log_evidence.ndim - 1))
    return np.asarray(np.exp(posterior - np.logaddexp.reduce(posterior, axis=0)))


def judge(values: np.ndarray, used: np.ndarray, log_prior: np.ndarray) -> Judgement:
    """Pool log evidences ``(model, scenes, units)`` of the units that are ``used`` (scenes, units).

    >>> found = judge(np.array([[[0.0, 0.0, 0.0]], [[-2.0, -2.1, -1.9]]]), np.ones((1, 3), bool), np.log([0.5, 0.5]))
    >>> found.choice.tolist(), found.probability[0].round(3).tolist()
    ([0], [0.998])
    >>> judge(np.array([[[0.0, 0.0, 0.0]], [[-9.0, 2.0, 1.0]]]), np.ones((1, 3), bool), np.log([0.5, 0.5])).choice
    array([-1])
    """
    values = np.where(used, values, 0.0)
    pooled = values.sum(axis=-1)
    probability = probabilities(pooled, log_prior)
    best = np.argmax(probability, axis=0)
    difference = np.take_along_axis(values, best[None, :, None], axis=0) - values
    count = used.sum(axis=-1)
    lead = difference.sum(axis=-1)
    offset = np.where(used, difference - (lead / np.maximum(count, 1))[..., None], 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        scatter = np.sqrt(count / (count - 1) * np.sum(offset**2, axis=-1))
    scatter = np.where(count > 1, scatter, np.nan)
    # a single term has no spread: it is judged by its probability alone
    clear = np.all((lead >= OUTSTANDING * scatter) | (count < 2), axis=0)
    certain = np.max(probability, axis=0) >= CERTAIN
    choice = np.where(certain & clear & (count > 0), best, -1)
    return Judgement(pooled, np.where(count > 0, probability, np.nan), scatter, choice)
