"""The whole chain against its truth, over seeds: chi-square per degree of freedom of the fitted Jones matrices."""

from __future__ import annotations

import tempfile

import jax
import numpy as np

from acquisition.demo import run_demo
from benchmarks.results import Results
from polinfer import Status

SEEDS = 6


def main() -> None:
    """Print the table."""
    results = Results("chain")
    for seed in range(SEEDS):
        with tempfile.TemporaryDirectory() as folder:
            result = run_demo(folder, seed)
        chi_square, freedom, pixels = result.chi_square
        light = np.sqrt((np.abs(result.measurement.illumination) ** 2).sum(-2).mean(-1))
        results.add(
            seed=seed,
            seconds=sum(result.seconds.values()),
            chi_square_per_degree=chi_square / freedom,
            pixels=pixels,
            bad_fit=int(np.count_nonzero(result.fit.status & int(Status.BAD_FIT))),
            relative_sigma=float(np.median(result.measurement.sigma / light)),
        )
    values = [row["chi_square_per_degree"] for row in results.rows]
    print(f"chi-square per degree of freedom: {min(values):.2f} to {max(values):.2f}, mean {np.mean(values):.2f}")
    results.save(results.lines("seconds", "chi_square_per_degree", "seed"))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
