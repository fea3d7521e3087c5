"""Run benchmarks: ``python -m benchmarks [NAME ...]``; without names, all that take under ten minutes."""

from __future__ import annotations

import argparse
import importlib

import jax

QUICK = ("inference", "retrieval")
ALL = (*QUICK, "chain")


def main() -> None:
    """Parse the command line and run."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("names", nargs="*", help=f"of {', '.join(ALL)}; default: {', '.join(QUICK)}")
    chosen = parser.parse_args().names or list(QUICK)
    unknown = sorted(set(chosen) - set(ALL))
    if unknown:
        parser.error(f"unknown benchmark {unknown[0]!r}; there are {', '.join(ALL)}")
    jax.config.update("jax_enable_x64", True)
    for name in chosen:
        importlib.import_module(f"benchmarks.{name}").main()


if __name__ == "__main__":
    main()
