"""Does ``BAD_FIT`` find scenes that the model does not describe? A part of ``benchmarks.hard_cases``.

Truths from the priors, three balanced states, of strength s in (0, 1):

- circular: a circular diattenuator of diattenuation s behind the sample, J -> (cos(b/2) 1 + sin(b/2) Y) J, s = sin b;
- mixture: the fields of two independent samples superposed, (1 - s) J_1 + s J_2, in all states;
- unsteady: the same in the last state only, so that the states do not share a matrix.

The flag's power is compared with one from paper: chi-square at the maximum follows a non-central chi-square
distribution with the degrees of freedom of the fit, and the non-centrality ``2 d^2 / sigma^2``, d the distance of the
clean fields from the nearest that the model can give, found by ``benchmarks.oracle``. Strength 0 is the model itself:
the false alarms, whose nominal rate is ``BAD_FIT_PROBABILITY``. The prediction is that of a flat model; where sigma is
large, edges and curvature are felt. ``z`` is the difference over its standard error, to whose square one pixel is
added: a few flags more or less than none are no evidence.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.stats import chi2, ncx2

import polinfer
from benchmarks import scenes
from benchmarks.oracle import Oracle
from benchmarks.results import Results
from polinfer import ComplexGain, Measurement, Model, Parameters, Status
from polinfer.fitting.residuals import BAD_FIT_PROBABILITY

SIGMAS = (0.1, 0.03, 0.01, 0.003)
STRENGTHS = (0.01, 0.03, 0.1, 0.3)
FINE, STARTS = 1e-3, 6  # sigma at which the nearest fields are sought: the prior has no say
ALARMS = 50  # times as many pixels without a misfit
DTYPES = ("complex128", "complex64")


def fields(kind: str, strength: float, first: np.ndarray, second: np.ndarray, states: np.ndarray) -> np.ndarray:
    """Clean responses ``(pixels, 2, n)`` of a scene outside the model."""
    if kind == "circular":
        half = 0.5 * np.arcsin(strength)
        return (np.cos(half) * np.eye(2) + np.sin(half) * np.array([[0, -1j], [1j, 0]])) @ first @ states
    mixed = (1 - strength) * first + strength * second
    if kind == "mixture":
        return mixed @ states
    return np.concatenate([first @ states[:, :-1], mixed @ states[:, -1:]], axis=-1)


def distances(oracle: Oracle, truth: Parameters, clean: np.ndarray, states: np.ndarray,
              rng: np.random.Generator) -> np.ndarray:  # fmt: skip
    """Squared distance ``d^2`` of fields from the nearest of the model, (pixels,); a gain is without a prior."""
    point, top = oracle.maximum(clean, states, FINE, STARTS, rng)
    near, other = oracle.climb(np.array(truth), clean, states, FINE)
    point = np.where(other > top, near, point)
    seen = np.moveaxis(oracle.jones(point), -1, 0) @ states
    if oracle.gain == "complex":
        factor = np.sum(seen.conj() * clean, axis=(-1, -2)) / np.sum(np.abs(seen) ** 2, axis=(-1, -2))
        seen = factor[:, None, None] * seen
    return np.sum(np.abs(seen - clean) ** 2, axis=(-1, -2))


def flagged(model: Model, clean: np.ndarray, states: np.ndarray, sigma: float, dtype: str,
            rng: np.random.Generator) -> np.ndarray:  # fmt: skip
    """Whether each pixel of noisy data is a bad fit."""
    noise = rng.normal(scale=sigma * np.sqrt(0.5), size=(2, *clean.shape))
    data = Measurement(states.astype(dtype), (clean + noise[0] + 1j * noise[1]).astype(dtype), np.array(sigma))
    return (polinfer.fit(model, data).status & Status.BAD_FIT) != 0


def add(results: Results, pixels: int, combinations: list[tuple[Any, str]]) -> Any:
    """Add rows and bars to those of the hard cases, and return the picture."""
    from matplotlib.figure import Figure

    gains, states = {"unit": None, "complex": ComplexGain(1.0)}, scenes.balanced_states()
    rng, worst = np.random.default_rng(11), 0.0
    alarms: dict[str, list[float]] = {dtype: [] for dtype in DTYPES}
    figure = Figure(figsize=(8, 4), layout="constrained")
    panels = figure.subplots(1, len(combinations), sharey=True)
    for axes, (ordering, gain) in zip(panels, combinations, strict=True):
        model, oracle = Model(ordering, gain=gains[gain]), Oracle(type(ordering).__name__, gain)
        freedom = 4 * states.shape[-1] - 5 - (0 if gain == "unit" else 2)
        threshold = chi2.isf(BAD_FIT_PROBABILITY, freedom)
        name = {"ordering": type(ordering).__name__, "gain": gain}
        for sigma in SIGMAS:
            truth = scenes.from_priors(model, ALARMS * pixels, rng)
            for dtype in DTYPES:
                found = flagged(model, scenes.jones(Model(ordering), truth) @ states, states, sigma, dtype, rng)
                rate, error = float(found.mean()), float(np.sqrt(BAD_FIT_PROBABILITY / found.size))
                z = (rate - BAD_FIT_PROBABILITY) / error
                alarms[dtype].append(z)
                results.add(kind="in the model", **name, dtype=dtype, sigma=sigma, strength=0.0, flagged=rate,
                            predicted=BAD_FIT_PROBABILITY, z=z)  # fmt: skip
        first, second = (scenes.from_priors(model, pixels, rng) for _ in (1, 2))
        one, two = (scenes.jones(Model(ordering), truth) for truth in (first, second))
        for kind in ("circular", "mixture", "unsteady"):
            powers: dict[float, list[float]] = {sigma: [] for sigma in SIGMAS}
            for strength in STRENGTHS:
                clean = fields(kind, strength, one, two, states)
                away = distances(oracle, first, clean, states, rng)
                for sigma in SIGMAS:
                    power = ncx2.sf(threshold, freedom, np.maximum(2 * away / sigma**2, 1e-9))
                    found = flagged(model, clean, states, sigma, "complex128", rng)
                    error = np.sqrt(np.sum(power * (1 - power)) + 1) / pixels
                    z = float((found.mean() - power.mean()) / error)
                    worst = max(worst, abs(z))
                    powers[sigma].append(float(found.mean()))
                    results.add(kind=kind, **name, dtype="complex128", sigma=sigma, strength=strength,
                                flagged=powers[sigma][-1], predicted=float(power.mean()), z=z)  # fmt: skip
            for number, sigma in enumerate(SIGMAS):
                style = {"circular": "o-", "mixture": "s--", "unsteady": "^:"}[kind]
                axes.semilogx(STRENGTHS, powers[sigma], style, color=f"C{number}", ms=4,
                              label=f"sigma {sigma:g}" if kind == "circular" else None)  # fmt: skip
        axes.set(title=f"{name['ordering']}, {gain} gain", xlabel="strength", ylabel="share flagged BAD_FIT")
        axes.legend(fontsize=7, title="circular -, mixture --, unsteady :", title_fontsize=7)
    for dtype, values in alarms.items():
        results.bar(f"{dtype}, false alarms above {BAD_FIT_PROBABILITY:g}, largest", max(values), 4, "standard errors")
    results.bar("power of BAD_FIT off the prediction, largest", worst, 4, "standard errors")
    return figure
