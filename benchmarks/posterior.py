"""How fast are full posteriors, and are they right? A frame by Gibbs, its evidence against quadrature, emcee beside it.

Speed: 27 x 36 pixels, three balanced states, truths from the priors; draws until every invariant of every pixel has
1000 effective ones (4 chains; pixels that fall short are drawn again with more sweeps), counted
apart by :meth:`polinfer.Draws.diagnostics`. Time is that of :func:`polinfer.sample` without evidence, fit
included, compiled before; the same with sigma inferred in every pixel. Summaries of a large frame in parts
(:func:`polinfer.summarise`): time a pixel, and by how much the memory of the process grows from a quarter of the
frame to the whole. Evidence: pixels with D from 0 to the edge against the four-dimensional grid of
:mod:`benchmarks.evidence`, with its time. Agreement: means of invariants of ``Gibbs`` and ``Ensemble``.
"""

from __future__ import annotations

import resource
from dataclasses import replace

import numpy as np
from scipy.stats import kstest, norm

import polinfer
from benchmarks import scenes
from benchmarks.evidence import GRID, whole_quadrature
from benchmarks.oracle import Oracle
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
SPREAD_D = np.array([0.0, 0.003, 0.01, 0.03, 0.1, 0.3, 0.6, 0.9, 0.97, 0.999])


def speed(results: Results, pixels: int) -> None:
    """Time of a frame, and the least effective number of draws of its pixels."""
    states = scenes.balanced_states()
    for (gain, (kind, bar)), sigma in ((g, s) for g in GAINS.items() for s in SIGMAS):
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


def evidence(results: Results, sigmas: tuple[float, ...]) -> None:
    """Against quadrature."""
    states, worst, z = scenes.balanced_states(), 0.0, []
    for ordering in (RetarderFirst(), PolariserFirst()):
        for sigma in sigmas:
            model = Model(ordering)
            truth = scenes.from_priors(model, 2 * len(SPREAD_D), np.random.default_rng(4))
            truth = truth._replace(diattenuation=np.repeat(SPREAD_D, 2))
            data = scenes.measure(model, truth, states, sigma, rng=5)
            draws = polinfer.sample(model, data, Gibbs(), draws=DRAWS, rng=6)
            cost = seconds(lambda m=model, d=data: polinfer.sample(m, d, Gibbs(), draws=DRAWS, rng=6)) - seconds(
                lambda m=model, d=data: polinfer.sample(m, d, Gibbs(evidence=False), draws=DRAWS, rng=6)
            )
            oracle = Oracle(type(ordering).__name__, "unit")
            expected = [whole_quadrature(oracle, r, states, sigma, GRID[sigma]) for r in data.response]
            off = draws.log_evidence - expected
            laplace = polinfer.fit(model, data).log_evidence - expected
            worst = max(worst, float(np.abs(off).max()))
            z += list(off / draws.log_evidence_error)
            results.add(
                ordering=type(ordering).__name__, evidence_sigma=sigma, worst=float(np.abs(off).max()),
                rms=float(np.sqrt(np.mean(off**2))), stated=float(draws.log_evidence_error.max()),
                worst_laplace=float(np.abs(laplace).max()), milliseconds_a_pixel=1e3 * cost / len(off),
            )  # fmt: skip
    print(f"  off over stated error: rms {np.sqrt(np.mean(np.square(z))):.2f}")
    results.bar("log evidence against quadrature, worst pixel", worst, 0.02, "nat")


def agreement(results: Results, pixels: int) -> None:
    """Means of invariants of both samplers, in standard errors."""
    states, z = scenes.balanced_states(), []
    for sigma in (0.05, 0.4):
        model = Model()
        truth = scenes.from_priors(model, pixels, np.random.default_rng(7))
        data = scenes.measure(model, truth, states, sigma, rng=8)
        ensemble = polinfer.sample(model, data, Ensemble(), draws=32 * 20, rng=9)
        gibbs = polinfer.sample(model, data, Gibbs(evidence=False), draws=2000, rng=9)
        pairs = []
        for draws in (gibbs, ensemble):
            values = np.stack([np.asarray(x) for x in invariants(model, Parameters(*draws.parameters)).values()])
            pairs.append((values.mean(axis=(1, 2)), values.mean(axis=2).var(axis=1, ddof=1) / CHAINS))
        (a, va), (b, vb) = pairs
        z += list(((a - b) / np.sqrt(va + vb)).ravel())
    # means of four chains each: about Student with six degrees of freedom
    p = kstest(norm.ppf(student(np.array(z))), norm.cdf).pvalue
    results.bar("agreement of Gibbs and Ensemble, p-value of all comparisons", float(p), 0.01, at_least=True)
    results.add(pixels=pixels, comparisons=len(z), rms_z=float(np.sqrt(np.mean(np.square(z)))), p_value=float(p))


def student(z: np.ndarray) -> np.ndarray:
    """Distribution function of Student's t with six degrees of freedom."""
    from scipy.stats import t

    return np.asarray(t.cdf(z, 6))


def main(size: int | None = None, full: bool = False) -> None:
    """Print the tables."""
    results = Results("posterior")
    speed(results, size or PIXELS)
    noise_unknown(results, size or PIXELS)
    stream(results, 65536 if full else 16384)
    evidence(results, (0.1, 0.2, 0.4) if full else (0.4,))
    agreement(results, 50 if full else 6)
    results.save()


if __name__ == "__main__":
    main()
