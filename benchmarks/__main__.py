"""Run benchmarks: ``python -m benchmarks [NAME ...]``; without names, those that take minutes, not hours: some
twenty together."""

from __future__ import annotations

import argparse
import importlib
import inspect

import jax

QUICK = ("speed", "optimum", "evidence", "accuracy", "retrieval")
ALL = (
    *QUICK,
    "bundle",
    "images",
    "recovery",
    "design",
    "intensities",
    "peers",
    "chain",
    "maps",
    "stored",
    "parts",
    "hard_cases",
    "ordering",
    "misalignment",
    "posterior",
    "calibration",
    "variational",
    "texture",
    "contrast",
    "cohort_contrast",
    "acquisition",
    "streaming",
    "accelerator",
)


def main() -> None:
    """Parse the command line and run."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("names", nargs="*", help=f"of {', '.join(ALL)}; default: {', '.join(QUICK)}")
    parser.add_argument("--size", type=int, help="pixels, instead of each script's own number")
    parser.add_argument("--full", action="store_true", help="all pixels and cases; up to an hour a script")
    given = parser.parse_args()
    unknown = sorted(set(given.names) - set(ALL))
    if unknown:
        parser.error(f"unknown benchmark {unknown[0]!r}; there are {', '.join(ALL)}")
    jax.config.update("jax_enable_x64", True)
    options = {"size": given.size, "full": given.full}
    for name in given.names or QUICK:
        function = importlib.import_module(f"benchmarks.{name}").main
        function(**{key: value for key, value in options.items() if key in inspect.signature(function).parameters})


if __name__ == "__main__":
    main()
