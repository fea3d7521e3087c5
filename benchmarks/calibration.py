"""Do posteriors hold what they say? Simulation-based calibration of ``Gibbs``.

Truths from the priors, data from the truths, ranks of the truths among the draws, for functions that the equivalent
sets share. Uniform ranks: chi-square tests in 20 bins, the smallest p-value times the number of tests against 0.01.
Coverage of the central 50, 68 and 95 % intervals.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from benchmarks import scenes
from benchmarks.results import Results
from polinfer import ComplexGain, Gibbs, InferredNoise, Model, PolariserFirst, RetarderFirst, calibration_ranks

SIMULATIONS = 2000
SIGMAS = (0.02, 0.2, 0.4)
LEVELS = (0.5, 0.68, 0.95)


def main(size: int | None = None) -> None:
    """Print the table."""
    from matplotlib.figure import Figure

    results, states = Results("calibration"), scenes.balanced_states()
    cases = [
        (Model(ordering, gain=gain), sigma)
        for ordering, gain, sigma in product((RetarderFirst(), PolariserFirst()), (None, ComplexGain(1.0)), SIGMAS)
    ]
    cases.append((Model(noise=InferredNoise(3.0, 0.3, "pixel")), None))
    smallest, tests, off = 1.0, 0, 0.0
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    for number, (model, sigma) in enumerate(cases):
        found = calibration_ranks(model, states, sigma, size or SIMULATIONS, Gibbs(thin=4, evidence=False), rng=number)
        p = found.p_values()
        smallest, tests = min(smallest, float(p.min())), tests + len(p)
        cover = {level: found.coverage(level) for level in LEVELS}
        off = max(off, *(100 * float(np.abs(values.mean() - level)) for level, values in cover.items()))
        results.add(
            ordering=type(model.ordering).__name__, gain=type(model.gain).__name__, sigma=sigma or "inferred",
            simulations=size or SIMULATIONS, least_p=float(p.min()),
            **{f"inside_{100 * k:.0f}": f"{100 * v.min():.1f}-{100 * v.max():.1f}" for k, v in cover.items()},
        )  # fmt: skip
        place = np.sort((found.ranks + 0.5) / (found.draws + 1), axis=1)
        axes.plot(place.T[:: max(place.shape[1] // 200, 1)],
                  (np.arange(place.shape[1])[:, None] / place.shape[1] - place.T)[:: max(place.shape[1] // 200, 1)],
                  color=f"C{number % 10}", lw=0.5)  # fmt: skip
    bound = 1.63 / (size or SIMULATIONS) ** 0.5
    axes.axhspan(-bound, bound, color="0.9", zorder=0)
    axes.set(xlabel="rank of the truth", ylabel="share of smaller ranks, less the rank",
             title="lines: functions of the parameters; grey: 99 % of their departures")  # fmt: skip
    results.bar("smallest p-value, times the number of tests", smallest * tests, 0.01, at_least=True)
    results.bar("coverage, mean over the functions, off by at most", off, 2.0, "points")
    results.save(figure)


if __name__ == "__main__":
    main()
