"""How fast are full posteriors, and are they right? A frame by Gibbs, its evidence against quadrature, emcee beside it.

Speed: 27 x 36 pixels, three balanced states, truths from the priors; draws until every invariant of every pixel has
1000 effective ones (4 chains; pixels that fall short are drawn again with more sweeps), counted
apart by :meth:`polinfer.Draws.diagnostics`. Time is that of :func:`polinfer.sample` without evidence, fit
included, compiled before; the same with sigma inferred in every pixel. Summaries of a large frame in parts
(:func:`polinfer.summarise`): time a pixel, and by how much the memory of the process grows from a quarter of the
frame to the whole. Evidence: pixels with D from 0 to the edge against :mod:`benchmarks.quadrature`, with its time.
Agreement: means of invariants of ``Gibbs`` and ``Ensemble``.
"""

from __future__ import annotations

import resource
from dataclasses import replace
from itertools import product

import numpy as np
from scipy.stats import kstest, ttest_ind

import polinfer
from benchmarks import scenes
from benchmarks.oracle import Oracle
from benchmarks.quadrature import importance, nested
from benchmarks.results import Results, alternating_seconds, median_seconds, seconds
from polinfer import (
    ComplexGain,
    Ensemble,
    Gibbs,
    InferredNoise,
    Measurement,
    Model,
    Parameters,
    PolariserFirst,
    RetarderFirst,
    Status,
)
from polinfer.sampling.invariants import invariants

PIXELS, EFFECTIVE, CHAINS, DRAWS = 972, 1000, 4, 1000
SIGMAS = (0.005, 0.02, 0.1, 0.4)
GAINS = {"unit": (None, 1.0), "complex": (ComplexGain(1.0), 2.0)}  # with the bar, seconds
AGREEMENT = ((0.05, None), (0.4, None), (0.4, ComplexGain(1.0)))
SPREAD_D = np.array([0.0, 0.003, 0.01, 0.03, 0.1, 0.3, 0.6, 0.9, 0.97, 0.999])


def speed(results: Results, pixels: int, sigmas: tuple[float, ...] = SIGMAS) -> None:
    """Time of a frame, and the least effective number of draws of its pixels."""
    states = scenes.balanced_states()
    for (gain, (kind, bar)), sigma in ((g, s) for g in GAINS.items() for s in sigmas):
        model = Model(gain=kind)
        truth = scenes.from_priors(model, pixels, np.random.default_rng(1))
        for dtype in ("complex64", "complex128"):
            data = scenes.measure(model, truth, states, sigma, dtype, rng=2)
            sampler = Gibbs(effective=EFFECTIVE, evidence=False)

            def run(model=model, data=data, sampler=sampler):  # type: ignore[no-untyped-def]
                return polinfer.sample(model, data, sampler, chains=CHAINS, draws=DRAWS + DRAWS // 4, rng=3)

            time = median_seconds(run, 3)
            draws = run()
            least = draws.diagnostics().ess.min(axis=-1)
            results.add(
                gain=gain, sigma=sigma, dtype=dtype, seconds=time, least_ess=float(least.min()),
                median_ess=float(np.median(least)), below_1000=int(np.sum(least < EFFECTIVE)),
                not_converged=int(np.sum(draws.status & int(Status.NOT_CONVERGED) != 0)),
            )  # fmt: skip
            if dtype == "complex64":
                results.bar(f"{pixels} pixels, {gain} gain, sigma {sigma}", time, bar, "s")


def noise_unknown(results: Results, pixels: int) -> None:
    """Time with sigma inferred in every pixel, over that with sigma known."""
    states, sigma = scenes.balanced_states(), 0.1
    truth = scenes.from_priors(Model(), pixels, np.random.default_rng(1))
    data = scenes.measure(Model(), truth, states, sigma, "complex64", rng=2)
    sampler = Gibbs(effective=EFFECTIVE, evidence=False)

    def run(model: Model, given: Measurement) -> polinfer.Draws:
        return polinfer.sample(model, given, sampler, chains=CHAINS, draws=DRAWS + DRAWS // 4, rng=3)

    inferred = Model(noise=InferredNoise(3.0, 0.03, "pixel"))
    times = alternating_seconds(
        {"known": lambda: run(Model(), data), "inferred": lambda: run(inferred, replace(data, sigma=None))}, 3
    )
    ratio = float(np.median(times["inferred"] / times["known"]))
    least = run(inferred, replace(data, sigma=None)).diagnostics().ess.min(axis=-1)
    results.add(noise="inferred", known_seconds=float(np.median(times["known"])),
                inferred_seconds=float(np.median(times["inferred"])), least_ess=float(least.min()))  # fmt: skip
    results.bar("time with sigma inferred over that with sigma known", ratio, 2.0)


def stream(results: Results, pixels: int) -> None:
    """Summaries in parts."""
    states, peak = scenes.balanced_states(), []
    for count in (pixels // 4, pixels):
        truth = scenes.from_priors(Model(), count, np.random.default_rng(1))
        data = scenes.measure(Model(), truth, states, 0.05, "complex64", rng=2)
        time = seconds(lambda d=data: polinfer.summarise(Model(), d, draws=DRAWS // 2, rng=3))
        peak.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20)
        results.add(
            streamed=count, draws=CHAINS * DRAWS // 2, milliseconds_a_pixel=1e3 * time / count, peak_GB=peak[-1]
        )
    results.bar("growth of the peak memory from a quarter of the frame to the whole", peak[1] - peak[0], 0.5, "GB")


def evidence(results: Results, sigmas: tuple[float, ...], kinds: tuple[str, ...]) -> None:
    """Against quadrature (unit gain) and importance sampling (complex gain), 20 pixels a case."""
    states, worst, z = scenes.balanced_states(), dict.fromkeys(kinds, 0.0), []
    for ordering, gain, sigma in product((RetarderFirst(), PolariserFirst()), kinds, sigmas):
        model = Model(ordering, gain=GAINS[gain][0])
        truth = scenes.from_priors(model, 2 * len(SPREAD_D), np.random.default_rng(4))
        truth = truth._replace(diattenuation=np.repeat(SPREAD_D, 2))
        data = scenes.measure(model, truth, states, sigma, rng=5)
        draws = polinfer.sample(model, data, Gibbs(), draws=DRAWS, rng=6)
        cost = seconds(lambda m=model, d=data: polinfer.sample(m, d, Gibbs(), draws=DRAWS, rng=6)) - seconds(
            lambda m=model, d=data: polinfer.sample(m, d, Gibbs(evidence=False), draws=DRAWS, rng=6)
        )
        found = polinfer.fit(model, data)
        if gain == "unit":
            oracle = Oracle(type(ordering).__name__, "unit")
            values = [(nested(oracle, r, states, sigma), 0.0) for r in data.response]
        else:
            # from other draws than those whose evidence is judged
            start = polinfer.sample(model, data, Gibbs(evidence=False), draws=DRAWS, rng=60).parameters
            values = [
                importance(model, data, found, k, 1, Parameters(*(np.asarray(x)[..., k].ravel() for x in start)))
                for k in range(len(data.response))
            ]
        expected, error = np.array(values).T
        off = draws.log_evidence - expected
        worst[gain] = max(worst[gain], float(np.abs(off).max()))
        z += list(off / np.hypot(draws.log_evidence_error, error))
        results.add(
            ordering=type(ordering).__name__, gain=gain, evidence_sigma=sigma, worst=float(np.abs(off).max()),
            rms=float(np.sqrt(np.mean(off**2))), stated=float(draws.log_evidence_error.max()),
            error_of_expected=float(error.max()), worst_laplace=float(np.abs(found.log_evidence - expected).max()),
            milliseconds_a_pixel=1e3 * cost / len(off),
        )  # fmt: skip
    print(f"  off over stated error: rms {np.sqrt(np.mean(np.square(z))):.2f}")
    for gain, value in worst.items():
        results.bar(f"log evidence, {gain} gain, against an independent computation, worst pixel", value, 0.02, "nat")


def agreement(results: Results, pixels: int) -> None:
    """Means of invariants and of their squares by both samplers, six chains each: Welch's test in every pixel."""
    states, values = scenes.balanced_states(), []
    sampler = Ensemble(warmup=100, thin=20, evidence=False)
    for sigma, gain in AGREEMENT:
        model = Model(gain=gain)
        truth = scenes.from_priors(model, pixels, np.random.default_rng(7))
        data = scenes.measure(model, truth, states, sigma, rng=8)
        ensemble = polinfer.sample(model, data, sampler, chains=6, draws=32 * 5, rng=9)
        gibbs = polinfer.sample(model, data, Gibbs(evidence=False), chains=6, draws=2000, rng=9)
        means = []
        for draws in (gibbs, ensemble):
            found = np.stack([np.asarray(x) for x in invariants(model, Parameters(*draws.parameters)).values()])
            means.append(np.concatenate([found, found**2]).mean(axis=2))  # (functions, chains, pixels)
        test = ttest_ind(*means, axis=1, equal_var=False)
        values.append(test.pvalue)
        results.add(
            agreement_sigma=sigma, gain=type(gain).__name__, pixels=pixels, functions=len(test.pvalue),
            below_5_percent=float(np.mean(test.pvalue < 0.05)), least_p=float(test.pvalue.min()),
            least_p_of_uniform=float(min(kstest(x, "uniform").pvalue for x in test.pvalue)),
        )  # fmt: skip
    every = np.concatenate(values)
    worst = float(every.min()) * every.size
    uniform = min(kstest(x, "uniform").pvalue for x in every) * len(every)
    results.bar("Gibbs and Ensemble: least p-value of a pixel, times their number", worst, 0.01, at_least=True)
    results.bar("  p-values are uniform over the pixels: least p-value, times the number of functions", uniform, 0.01,
                at_least=True)  # fmt: skip


def main(size: int | None = None, full: bool = False, quick: bool = False) -> None:
    """Print the tables. ``quick``: time and effective draws of a frame at one noise."""
    results = Results("posterior")
    if quick:
        speed(results, size or PIXELS, (0.02,))
        results.save()
        return
    speed(results, size or PIXELS)
    noise_unknown(results, size or PIXELS)
    stream(results, 65536 if full else 16384)
    evidence(results, (0.005, 0.02, 0.1, 0.4) if full else (0.02, 0.4), ("unit", "complex") if full else ("unit",))
    agreement(results, 50 if full else 6)
    results.save()


if __name__ == "__main__":
    main()
