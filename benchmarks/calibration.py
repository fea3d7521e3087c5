"""Do posteriors hold what they say? Simulation-based calibration of ``Gibbs``.

Truths from the priors, data from the truths, ranks of the truths among the draws, for functions that the equivalent
sets share. Uniform ranks: chi-square tests in 20 bins, the smallest p-value times the number of tests against 0.01.
Coverage of the central 50, 68 and 95 % intervals. ``Ensemble`` takes about half a second a simulation, so it has fewer
of them, 300 a case with ``--full``.
"""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks import scenes
from benchmarks.results import Results
from polinfer import ComplexGain, Ensemble, Gibbs, InferredNoise, Model, PolariserFirst, RetarderFirst
from polinfer import calibration_ranks as ranks_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SIGMAS = (0.02, 0.2, 0.4)
LEVELS = (0.5, 0.68, 0.95)
CASES: list[tuple[Model, float | None]] = [
    (Model(ordering, gain=gain), sigma)
    for ordering, gain, sigma in product((RetarderFirst(), PolariserFirst()), (None, ComplexGain(1.0)), SIGMAS)
]
CASES.append((Model(noise=InferredNoise(3.0, 0.3, "pixel")), None))
# light three times as strong in one polarisation as in the other, whose conditionals have second harmonics
BALANCED, UNBALANCED = scenes.balanced_states(), scenes.conditioned_states(3**0.5, np.random.default_rng(1))
SKEW: list[tuple[Model, float | None]] = [
    (Model(ordering, gain=gain), sigma)
    for ordering, gain, sigma in product((RetarderFirst(), PolariserFirst()), (None, ComplexGain(1.0)), (0.02, 0.2))
]
GIBBS, ENSEMBLE = Gibbs(thin=4, evidence=False), Ensemble(warmup=100, thin=20, evidence=False)


def calibrate(results: Results, sampler: Gibbs | Ensemble, simulations: int, draws: int, axes: Any) -> None:
    """All cases of one sampler."""
    name = type(sampler).__name__
    smallest, tests, off = 1.0, 0, 0.0
    cases = [(*case, BALANCED) for case in CASES] + [(*case, UNBALANCED) for case in SKEW]
    for number, (model, sigma, states) in enumerate(cases):
        found = ranks_of(model, states, sigma, simulations, sampler, rng=number, draws=draws)
        p = found.p_values()
        smallest, tests = min(smallest, float(p.min())), tests + len(p)
        cover = {level: found.coverage(level) for level in LEVELS}
        off = max(off, *(100 * float(np.abs(values.mean() - level)) for level, values in cover.items()))
        results.add(
            sampler=name, ordering=type(model.ordering).__name__, gain=type(model.gain).__name__,
            light="balanced" if states is BALANCED else "3 : 1", sigma=sigma or "inferred", simulations=simulations,
            least_p=float(p.min()),
            **{f"inside_{100 * k:.0f}": f"{100 * v.min():.1f}-{100 * v.max():.1f}" for k, v in cover.items()},
        )  # fmt: skip
        place = np.sort((found.ranks + 0.5) / (found.draws + 1), axis=1)
        axes.plot(place.T[:: max(place.shape[1] // 200, 1)],
                  (np.arange(place.shape[1])[:, None] / place.shape[1] - place.T)[:: max(place.shape[1] // 200, 1)],
                  color=f"C{number % 10}", lw=0.5)  # fmt: skip
    bound = 1.63 / simulations**0.5
    axes.axhspan(-bound, bound, color="0.9", zorder=0)
    axes.set(xlabel="rank of the truth", ylabel="share of smaller ranks, less the rank",
             title=f"{name}: functions of the parameters; grey: 99 %")  # fmt: skip
    results.bar(f"{name}: smallest p-value, times the number of tests", smallest * tests, 0.01, at_least=True)
    results.bar(f"{name}: coverage, mean over the functions, off by at most", off, 2.0, "points")


def picture() -> Figure:
    """Room for the ranks of both samplers."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4), layout="constrained")
    figure.subplots(1, 2)
    return figure


def main(size: int | None = None, full: bool = False) -> None:
    """Print the table; ``size`` is the number of simulations of each case."""
    results, figure = Results("calibration"), picture()
    calibrate(results, GIBBS, size or 2000, 199, figure.axes[0])
    calibrate(results, ENSEMBLE, size or (300 if full else 30), 59, figure.axes[1])
    results.save(figure)


if __name__ == "__main__":
    main()
