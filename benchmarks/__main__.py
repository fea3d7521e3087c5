"""Run benchmarks: ``python -m benchmarks [NAME ...]``; without names a quick round of one for each part, below ten
minutes on two cores."""

from __future__ import annotations

import argparse
import importlib
import inspect

import jax

from benchmarks.results import keep

# by name, with a size where the benchmark's own takes long
QUICK: dict[str, dict[str, int]] = {
    "accuracy": {},
    "retrieval": {"size": 240},
    "recovery": {"size": 8},
    "ordering": {"size": 4},
    "posterior": {},
    "misalignment": {"size": 2},
    "texture": {},
    "stored": {},
    "streaming": {},
}
ALL = (
    "speed",
    "optimum",
    "evidence",
    "accuracy",
    "retrieval",
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
    "checks",
    "accelerator",
)


def main() -> None:
    """Parse the command line and run."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("names", nargs="*", help=f"of {', '.join(ALL)}; default: {', '.join(QUICK)}")
    parser.add_argument("--size", type=int, help="pixels, instead of each script's own number")
    parser.add_argument("--full", action="store_true", help="all pixels and cases; up to an hour a script")
    parser.add_argument(
        "--quick", action="store_true", help="the first questions only of those that have many; without names always"
    )
    parser.add_argument(
        "--page", action="store_true", help="then rewrite docs/results.md, with ratios to the figures it had"
    )
    given = parser.parse_args()
    unknown = sorted(set(given.names) - set(ALL))
    if unknown:
        parser.error(f"unknown benchmark {unknown[0]!r}; there are {', '.join(ALL)}")
    jax.config.update("jax_enable_x64", True)
    quick = given.quick or not (given.names or given.full)
    options = {"size": given.size, "full": given.full, "quick": quick}
    for name in given.names or QUICK:
        function = importlib.import_module(f"benchmarks.{name}").main
        own = {} if given.names else QUICK[name]
        takes = inspect.signature(function).parameters
        function(**{key: value for key, value in (options | own).items() if key in takes})
        if given.page:
            size = own.get("size", given.size)
            arguments = ("" if size is None else f" --size {size}") + (" --full" if given.full else "")
            arguments += " --quick" if quick and "quick" in takes else ""
            print(f"wrote {keep([name], arguments)}")


if __name__ == "__main__":
    main()
