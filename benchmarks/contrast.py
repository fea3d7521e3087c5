"""Do the intervals of :mod:`polinfer.contrast` hold the truth as often as they say?

Two regions with normal values, so that the truths are known: CNR, and gCNR = 2 Phi(CNR / sqrt 2) - 1.

- independent: pixels that are, ``samples`` not given;
- samples: as the paper's, 9 of which 6 have a lesion, or 20; both regions of a sample have a common normal deviate,
  each region one of its own, and each pixel one. Their spreads go from nearly independent pixels to samples within
  which hardly anything varies. Beside it the percentile interval of the same bootstrap, which is not used;
- image: one frame of a Gaussian field with correlation length 2 pixels and a round lesion, its pixels taken as
  independent and in tiles.

The second part, the contrast of every map of a cohort, is ``benchmarks.cohort_contrast``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.stats import norm

from benchmarks.results import Results
from polinfer import contrast
from polinfer.phantoms.random_fields import smooth_field

RUNS, FULL = 300, 1000
RESAMPLES, LEVEL = 400, 0.95
PIXELS = 100  # of each region of a sample
SPREADS = {"small": (0.3, 0.2, 1.0), "medium": (0.7, 0.3, 1.0), "large": (1.0, 1.0, 0.5)}
SEPARATIONS = (0.0, 0.5, 1.5, 4.0)  # of the means, in units of the whole standard deviation

Scene = tuple[np.ndarray, np.ndarray, np.ndarray | None]


def independent(count: int, separation: float, rng: np.random.Generator) -> Scene:
    """``count`` pixels of each region."""
    labels = np.repeat([0, 1], count)
    return rng.normal(separation * labels), labels, None


def samples(
    first: int, second: int, spread: tuple[float, float, float], separation: float, rng: np.random.Generator
) -> Scene:
    """The second region is in ``second`` of ``first`` samples. spread: of samples, of their regions, of pixels."""
    number = np.concatenate([np.repeat(np.arange(n), PIXELS) for n in (first, second)])
    labels = np.repeat([0, 1], [first * PIXELS, second * PIXELS])
    common, own = rng.normal(0, spread[0], first), rng.normal(0, spread[1], (2, first))
    values = common[number] + own[labels, number] + rng.normal(0, spread[2], labels.size)
    return values + separation * np.linalg.norm(spread) * labels, labels, number


def image(separation: float, size: int | None, rng: np.random.Generator) -> Scene:
    """A frame of 96 x 96 pixels, in tiles of ``size`` or none."""
    y, x = np.mgrid[:96, :96] - 47.5
    labels = (np.hypot(y, x) < 24).astype(int)
    values = smooth_field(rng, labels.shape, 2.0) + separation * labels
    return values, labels, None if size is None else contrast.tiles(labels.shape, size)


def percentile(values: np.ndarray, labels: np.ndarray, number: np.ndarray | None, seed: int) -> tuple[float, float]:
    """Percentiles of the signed CNR of resampled samples, or of resampled pixels."""
    rng = np.random.default_rng(seed)
    units = np.arange(values.size) if number is None else number.ravel()
    drawn = rng.multinomial(units.max() + 1, np.full(units.max() + 1, 1 / (units.max() + 1)), RESAMPLES)
    moments = []
    for region in (0, 1):
        inside = labels.ravel() == region
        powers = [values.ravel()[inside] ** k for k in range(3)]
        count, first, second = (drawn @ np.bincount(units[inside], p, units.max() + 1) for p in powers)
        with np.errstate(divide="ignore", invalid="ignore"):
            moments.append((first / count, second / count - (first / count) ** 2))
    (a, s), (b, t) = moments
    with np.errstate(divide="ignore", invalid="ignore"):
        low, high = np.nanquantile((b - a) / np.sqrt(s + t), [0.5 - LEVEL / 2, 0.5 + LEVEL / 2])
    return float(low), float(high)


def coverage(make: Callable[[np.random.Generator], Scene], separation: float, runs: int) -> dict[str, Any]:
    """How often each interval held the truth, its median width, and the mean of the estimates."""
    truths = {"cnr": separation / 2**0.5, "gcnr": 2 * norm.cdf(separation / 2) - 1}
    held = dict.fromkeys(("cnr", "gcnr", "percentile"), 0)
    values: dict[str, list[float]] = {"cnr": [], "gcnr": []}
    widths: dict[str, list[float]] = {"cnr": [], "gcnr": []}
    for seed in range(runs):
        scene = make(np.random.default_rng(seed))
        for name, measure in (("cnr", contrast.cnr), ("gcnr", contrast.gcnr)):
            found = measure(scene[0], scene[1], samples=scene[2], level=LEVEL, resamples=RESAMPLES, rng=seed)
            held[name] += found.low <= truths[name] <= found.high
            values[name].append(found.value)
            widths[name].append(found.high - found.low)
        low, high = percentile(*scene, seed)
        held["percentile"] += low <= truths["cnr"] <= high
    row: dict[str, Any] = {}
    for name, truth in truths.items():
        row |= {
            name: truth,
            f"mean_{name}": float(np.mean(values[name])),
            f"width_{name}": float(np.median(widths[name])),
        }
    return row | {f"held_{name}": count / runs for name, count in held.items()}


def main(size: int | None = None, full: bool = False) -> None:
    """Print the table; ``size``: simulations a row."""
    runs = size or (FULL if full else RUNS)
    results = Results("contrast")
    error = (LEVEL * (1 - LEVEL) / runs) ** 0.5
    print(f"{runs} simulations a row: the standard error of a share of {LEVEL:.0%} is {error:.1%}")
    scenes: dict[tuple[str, str], Callable[[float, np.random.Generator], Scene]] = {
        ("independent", "400 pixels"): lambda d, rng: independent(400, d, rng)
    }
    for first, second in ((9, 6), (20, 20)):
        for name, spread in SPREADS.items():
            scenes["samples", f"{first} and {second}, {name}"] = (
                lambda d, rng, f=first, s=second, w=spread: samples(f, s, w, d, rng)
            )  # fmt: skip
    for (kind, name), make in scenes.items():
        for separation in SEPARATIONS:
            row = coverage(lambda rng, m=make, d=separation: m(d, rng), separation, runs)  # type: ignore[misc]
            results.add(kind=kind, units=name, **row)
    judged = list(results.rows)
    for tile in (None, 16):
        row = coverage(lambda rng, t=tile: image(1.5, t, rng), 1.5, runs)  # type: ignore[misc]
        results.add(kind="image", units="pixels" if tile is None else f"tiles of {tile}", **row)
    judged.append(results.rows[-1])
    for name in ("cnr", "gcnr"):
        shares = [row[f"held_{name}"] for row in judged]
        results.bar(
            f"mean share of 95 % intervals of {name} that hold the truth", float(np.mean(shares)), 0.94, "", True
        )
        results.bar(f"least share, {name}", min(shares), LEVEL - 3 * error, "", True)
        results.bar(f"mean distance from 95 %, {name}", float(np.mean(np.abs(np.array(shares) - LEVEL))), 0.03)
    results.save()


if __name__ == "__main__":
    main()
