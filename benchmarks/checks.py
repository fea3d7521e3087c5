"""The slow tests and the whole width of the random ones: ``pytest -m slow``, then the parsers with POLINFER_FUZZ=fuzz.

They take longer than a change should wait for; most are further cases of a quick test. Reported: how many passed,
failed and were skipped, and the time; the bar is that none fails.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import defusedxml.ElementTree

from benchmarks.results import Results

TOP = Path(__file__).parents[1]
ROUNDS: dict[str, tuple[list[str], dict[str, str]]] = {
    "slow tests": (["-m", "slow"], {}),
    "random bytes": (["tests/acquisition/test_parsers.py"], {"POLINFER_FUZZ": "fuzz"}),
}


def run(arguments: list[str], variables: dict[str, str]) -> dict[str, float]:
    """Numbers of tests by outcome of one run of pytest, and its seconds."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        start = time.perf_counter()
        subprocess.run(
            [sys.executable, "-m", "pytest", "-q", f"--junitxml={report}", *arguments],
            cwd=TOP, env=os.environ | variables, check=False,
        )  # fmt: skip
        spent = time.perf_counter() - start
        suite = defusedxml.ElementTree.parse(report).getroot().find("testsuite")
    assert suite is not None
    count = {name: int(suite.get(name, "0")) for name in ("tests", "failures", "errors", "skipped")}
    failed = count["failures"] + count["errors"]
    return {"passed": count["tests"] - failed - count["skipped"], "failed": failed, "skipped": count["skipped"],
            "seconds": round(spent, 1)}  # fmt: skip


def main() -> None:
    """Print the table."""
    results = Results("checks")
    for name, given in ROUNDS.items():
        found = run(*given)
        results.add(round=name, **found)
        results.bar(f"{name}: failed", found["failed"], 0)
    results.save()


if __name__ == "__main__":
    main()
