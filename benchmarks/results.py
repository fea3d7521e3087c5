"""Timing, and where results go: a printed table, JSON beside it, and a picture of error against time."""

from __future__ import annotations

import json
import os
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

FOLDER = Path(__file__).parent / "results"


def median_seconds(function: Callable[[], Any], repeats: int = 5) -> float:
    """Median wall time of a call whose result is NumPy (so it is finished), after one call that is not counted."""
    function()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def machine() -> dict[str, str]:
    """What the figures were measured on."""
    versions = {name: metadata.version(name) for name in ("polinfer", "numpy", "scipy", "jax")}
    return {
        "processor": platform.processor() or platform.machine(),
        "cores": str(os.cpu_count()),
        "python": platform.python_version(),
        "date": datetime.now(UTC).date().isoformat(),
        **versions,
    }


@dataclass
class Results:
    """Rows of one benchmark."""

    name: str
    rows: list[dict[str, Any]] = field(default_factory=list)

    def add(self, **row: Any) -> None:
        """Add a row and print it."""
        if not self.rows:
            print(f"\n== {self.name}: {machine()}")
            print(" | ".join(f"{key:>22s}" for key in row))
        self.rows.append(row)
        print(" | ".join(f"{v:22.4g}" if isinstance(v, float) else f"{v!s:>22s}" for v in row.values()))

    def save(self, x: str, y: str, group: str) -> None:
        """Write JSON and a picture of y against x, a line for each value of ``group``."""
        from matplotlib.figure import Figure

        FOLDER.mkdir(exist_ok=True)
        path = FOLDER / f"{self.name}.json"
        path.write_text(json.dumps({"machine": machine(), "rows": self.rows}, indent=1))
        figure = Figure(figsize=(6, 4), layout="constrained")
        axes = figure.subplots()
        for value in dict.fromkeys(row[group] for row in self.rows):
            rows = [row for row in self.rows if row[group] == value]
            axes.loglog([row[x] for row in rows], [row[y] for row in rows], "o-", label=str(value))
        axes.set_xlabel(x)
        axes.set_ylabel(y)
        axes.legend(fontsize=8)
        axes.grid(alpha=0.3)
        figure.savefig(path.with_suffix(".png"), dpi=120)
        print(f"wrote {path} and {path.with_suffix('.png')}")
