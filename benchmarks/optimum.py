"""Does ``fit`` find the best mode? Against the best of 32 random starts of an optimiser that shares no code with it.

The deficit is the log posterior of the best start less that of the reported parameters, both by the formulas of
``benchmarks.oracle``. Default: 500 pixels for a case; ``--full``: 5000.
"""

from __future__ import annotations

from itertools import product

import numpy as np

import polinfer
from benchmarks import scenes
from benchmarks.oracle import Oracle
from benchmarks.results import Results
from polinfer import ComplexGain, Measurement, Model, PolariserFirst, RetarderFirst

PIXELS, FULL, STARTS = 500, 5000, 32
SIGMAS = (0.005, 0.02, 0.2, 0.4)
GAINS = {"unit": None, "complex": ComplexGain(1.0)}
TOLERANCE = {"complex128": 1e-3, "complex64": 1e-2}  # nat
# name: condition number of U, share of pixels that must reach the best mode
STATES = {"balanced": (1.0, 0.999), "cond(S) = 5": (5**0.5, 0.99), "cond(S) = 30": (30**0.5, 0.99),
          "cond(S) = 900": (30.0, None)}  # fmt: skip


def case(model: Model, gain: str, condition: float, sigma: float, pixels: int, rng: np.random.Generator) -> dict:
    """Deficits (nat) of both precisions, and how far the log density that is reported is from the oracle's."""
    truth = scenes.from_priors(model, pixels, rng)
    # five sets of states, so that no single one decides
    states = np.stack([scenes.conditioned_states(condition, rng) for _ in range(5)]).repeat(-(-pixels // 5), 0)[:pixels]
    data = scenes.measure(model, truth, states, sigma, rng=int(rng.integers(2**31)))
    oracle = Oracle(type(model.ordering).__name__, gain)
    _, best = oracle.maximum(data.response, states, sigma, STARTS, rng)
    found = {"best": best}
    for dtype in TOLERANCE:
        given = Measurement(states.astype(dtype), data.response.astype(dtype), data.sigma)
        result = polinfer.fit(model, given)
        point = np.array([np.asarray(x, float) for x in result.parameters])
        # in single precision the rounded data are the data
        own = oracle.log_posterior(point, given.response.astype(complex), given.illumination.astype(complex), sigma)
        reference = best
        if dtype == "complex64":
            _, near = oracle.climb(point, given.response.astype(complex), given.illumination.astype(complex), sigma)
            shift = oracle.climb(point, data.response, states, sigma)[1]
            reference = best - shift + near
        found[dtype] = np.nan_to_num(reference - own, nan=np.inf)
        found["reported " + dtype] = np.abs(result.log_posterior - own)
    return found


def main(size: int | None = None, full: bool = False) -> None:
    """Print the table."""
    from matplotlib.figure import Figure

    pixels = size or (FULL if full else PIXELS)
    results = Results("optimum")
    rng = np.random.default_rng(1)
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    reached: dict[tuple[str, str], list[np.ndarray]] = {}
    for (states, (condition, _)), ordering, gain, sigma in product(
        STATES.items(), (RetarderFirst(), PolariserFirst()), GAINS, SIGMAS
    ):
        if states != "balanced" and not full and sigma not in (0.02, 0.4):
            continue
        found = case(Model(ordering, gain=GAINS[gain]), gain, condition, sigma, pixels, rng)
        row = {"states": states, "ordering": type(ordering).__name__, "gain": gain, "sigma": sigma, "pixels": pixels}
        for dtype, tolerance in TOLERANCE.items():
            deficit = found[dtype]
            row |= {f"reached_{dtype}": float(100 * np.mean(deficit < tolerance)),
                    f"worst_{dtype}": float(deficit.max())}  # fmt: skip
            reached.setdefault((states, dtype), []).append(deficit < tolerance)
        row["reported_off"] = float(found["reported complex128"].max())
        results.add(**row)
        if sigma == SIGMAS[-1]:
            axes.plot(np.sort(np.maximum(found["complex128"], 1e-12))[::-1], np.arange(pixels) / pixels,
                      label=f"{states}, {row['ordering']}, {gain}")  # fmt: skip
    for (states, dtype), values in reached.items():
        bar = STATES[states][1]
        share = 100 * np.mean(np.concatenate(values))
        claim = f"{states}, {dtype}: pixels within {TOLERANCE[dtype]:g} nat of the best of {STARTS} starts"
        if bar is None:
            print(f"  [no bar] {claim}: {share:.2f} %")
        else:
            results.bar(claim, share, 100 * bar, "%", at_least=True)
    axes.axvline(TOLERANCE["complex128"], color="k", lw=0.8)
    axes.set(xscale="log", yscale="log", xlabel="nat below the best start, at least", ylabel="share of pixels",
             title=f"sigma {SIGMAS[-1]}")  # fmt: skip
    axes.legend(fontsize=6)
    results.save(figure)


if __name__ == "__main__":
    main()
