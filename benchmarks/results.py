"""Timing, bars, fresh processes, and where results go: a printed table, JSON beside it, a picture, and a page of the
documentation with the figures of the last runs and their ratios to the ones before."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FOLDER = Path(__file__).parent / "results"
LAST = Path(__file__).parent / "last.json"  # what the page is made of
PAGE = Path(__file__).parents[1] / "docs" / "results.md"


def seconds(function: Callable[[], Any]) -> float:
    """Wall time of one call whose result is NumPy (so it is finished)."""
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def alternating_seconds(functions: dict[str, Callable[[], Any]], repeats: int = 5) -> dict[str, np.ndarray]:
    """Wall times of several functions that take turns, so that a slow spell of the machine hits all of them.

    Every other round is in reverse: who comes first finds the memory as the last of the round before left it.
    """
    times: dict[str, list[float]] = {name: [] for name in functions}
    for k in range(repeats):
        for name, function in list(functions.items())[:: -1 if k % 2 else 1]:
            times[name].append(seconds(function))
    return {name: np.array(values) for name, values in times.items()}


def median_seconds(function: Callable[[], Any], repeats: int = 5) -> float:
    """Median wall time of a call, after one call that is not counted."""
    function()
    return float(np.median([seconds(function) for _ in range(repeats)]))


def in_fresh_process(function: Callable[..., Any], *arguments: Any, double: bool, **variables: str) -> Any:
    """``function(*arguments)`` in a process of its own, without compiled code, in one precision of JAX.

    Arguments and result travel as JSON; ``variables`` are set in its environment.
    """
    code = (
        f"import json\nfrom {function.__module__} import {function.__name__} as f\n"
        f"print('\\n' + json.dumps(f(*json.loads({json.dumps(json.dumps(arguments))}))))"
    )
    environment = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    environment |= {"JAX_ENABLE_X64": str(int(double)), **variables}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment, cwd=Path(__file__).parents[1]
    )
    if done.returncode:
        raise RuntimeError(f"{function.__name__}{arguments} failed:\n{done.stderr}")
    return json.loads(done.stdout.rstrip().rsplit("\n", 1)[-1])


def machine() -> dict[str, str]:
    """What the figures were measured on."""
    versions = {name: metadata.version(name) for name in ("polinfer", "numpy", "scipy", "jax")}
    model = [line.split(":")[1].strip() for line in _lines("/proc/cpuinfo") if line.startswith("model name")]
    return {
        "processor": (model or [platform.processor() or platform.machine()])[0],
        "cores": str(os.cpu_count()),
        "python": platform.python_version(),
        "date": datetime.now(UTC).date().isoformat(),
        **versions,
    }


def _lines(path: str) -> list[str]:
    return Path(path).read_text().splitlines() if Path(path).exists() else []


def keep(names: list[str], arguments: str) -> Path:
    """Put the bars of these benchmarks, run just now, in the place of their last figures, and write the page."""
    last = json.loads(LAST.read_text()) if LAST.exists() else {}
    for name in names:
        path = FOLDER / f"{name}.json"
        if not path.exists():
            continue
        found = json.loads(path.read_text())
        before = {bar["claim"]: bar["measured"] for bar in last.get(name, {}).get("bars", [])}
        for bar in found["bars"]:
            earlier = before.get(bar["claim"])
            bar["ratio"] = bar["measured"] / earlier if earlier else None
        last[name] = {"arguments": arguments, "before": last.get(name, {}).get("machine", {}).get("date"),
                      **{key: found[key] for key in ("machine", "seconds", "bars")}}  # fmt: skip
    LAST.write_text(json.dumps(last, indent=1, sort_keys=True) + "\n")
    PAGE.write_text(_page(last))
    return PAGE


def _page(last: dict[str, Any]) -> str:
    lines = [
        "# Figures of the last benchmark runs",
        "",
        "Written by `python -m benchmarks NAME ... --page` from a checkout, one section a benchmark; what each "
        "measures is in the first lines of its file in `benchmarks/`. *Ratio*: to the run before, where there was one. "
        "Times are those of the machine that is named, on which others work as well: compare ratios, not seconds. A "
        "miss is a bar that the code does not reach.",
        "",
    ]
    for name, run in sorted(last.items()):
        of = run["machine"]
        versions = ", ".join(f"{key} {of[key]}" for key in ("polinfer", "numpy", "scipy", "jax"))
        lines += [
            f"## {name}",
            "",
            f"`python -m benchmarks {name}{run['arguments']}`: {of['date']}, {of['processor']}, {of['cores']} cores, "
            f"Python {of['python']}, {versions}; {run['seconds']:.0f} s"
            + (f"; ratios to {run['before']}." if run["before"] else "."),
            "",
        ]
        if not run["bars"]:
            lines += ["No bars: it prints tables.", ""]
            continue
        lines += ["| claim | measured | bar | | ratio |", "|---|---|---|---|---|"]
        for bar in run["bars"]:
            held = bar["measured"] >= bar["bar"] if bar["at_least"] else bar["measured"] <= bar["bar"]
            ratio = f"{bar['ratio']:.2f}" if bar.get("ratio") is not None else ""
            claim = bar["claim"].replace("|", "\\|")
            sign = "≥" if bar["at_least"] else "≤"
            lines.append(f"| {claim} | {bar['measured']:.4g} {bar['unit']} | {sign} {bar['bar']:g} | "
                         f"{'holds' if held else 'MISS'} | {ratio} |")  # fmt: skip
        lines.append("")
    return "\n".join(lines)


@dataclass
class Results:
    """Rows and bars of one benchmark."""

    name: str
    rows: list[dict[str, Any]] = field(default_factory=list)
    bars: list[dict[str, Any]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.began = time.perf_counter()
        print(f"\n== {self.name}: " + ", ".join(f"{k} {v}" for k, v in machine().items()))

    def add(self, **row: Any) -> None:
        """Add a row and print it, below its column names if they are new."""
        widths = {key: max(len(key), 9) for key in row}
        if not self.rows or list(self.rows[-1]) != list(row):
            print("\n" + " | ".join(f"{key:>{width}s}" for key, width in widths.items()))
        self.rows.append(row)
        texts = ((f"{v:.4g}" if isinstance(v, float) else str(v)) for v in row.values())
        print(" | ".join(f"{text:>{width}s}" for text, width in zip(texts, widths.values(), strict=True)), flush=True)

    def bar(self, claim: str, measured: float, bar: float, unit: str = "", at_least: bool = False) -> None:
        """Print a figure beside its bar; NaN misses."""
        held = bool(measured >= bar if at_least else measured <= bar)
        self.bars.append(
            {"claim": claim, "measured": float(measured), "bar": float(bar), "unit": unit, "at_least": at_least}
        )
        sign = ">=" if at_least else "<="
        print(f"  [{'pass' if held else 'MISS'}] {claim}: {measured:.5g} {unit} (bar {sign} {bar:g})", flush=True)

    def save(self, figure: Figure | None = None) -> None:
        """Write JSON, and the picture if there is one."""
        FOLDER.mkdir(exist_ok=True)
        path = FOLDER / f"{self.name}.json"
        spent = time.perf_counter() - self.began
        found = {"machine": machine(), "seconds": spent, "bars": self.bars, "rows": self.rows}
        path.write_text(json.dumps(found, indent=1))
        if figure is not None:
            figure.savefig(path.with_suffix(".png"), dpi=120)
        print(f"wrote {path}" + (f" and {path.with_suffix('.png').name}" if figure is not None else ""))

    def lines(self, x: str, y: str, group: str) -> Figure:
        """A picture of y against x, a line for each value of ``group``."""
        from matplotlib.figure import Figure

        figure = Figure(figsize=(6, 4), layout="constrained")
        axes = figure.subplots()
        for value in dict.fromkeys(row[group] for row in self.rows if group in row):
            rows = [row for row in self.rows if row.get(group) == value]
            axes.loglog([row[x] for row in rows], [row[y] for row in rows], "o-", label=str(value))
        axes.set_xlabel(x.replace("_", " "))
        axes.set_ylabel(y.replace("_", " "))
        axes.legend(fontsize=8)
        axes.grid(alpha=0.3)
        return figure
