"""One propagation through the bundle at full size: time in pairs of FFTs, memory, and the adjoint's exactness.

A frame of 1200 x 1200 pixels of 0.39 um, some 9000 fibrelets, both polarisations, complex64. In NumPy and as the
compiled JAX function; with the sample on the facet and 50 um in front of it. Memory is that of a fresh process at its
highest, imports included. ``size``: the side of the frame.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import scipy.fft

from benchmarks.results import Results, in_fresh_process, median_seconds
from fibre import Bundle, Frame, Transmission

PIXEL = 0.39e-6


def made(side: int, distance: float) -> tuple[Transmission, np.ndarray]:
    """The path, and random fields (2, y, x)."""
    frame = Frame((side, side), PIXEL)
    bundle = Bundle.hexagonal(radius=0.48 * side * PIXEL, rng=0)
    parts = np.random.default_rng(1).standard_normal((2, 2, side, side), np.float32)
    return Transmission(bundle, frame, frame, distance=distance), parts[0] + 1j * parts[1]


def memory(side: int, distance: float) -> float:
    """Highest resident memory of one propagation and one adjoint, GB."""
    path, fields = made(side, distance)
    path.adjoint(path.propagate(fields))
    # not getrusage, whose figure a child inherits from its parent
    line = next(x for x in Path("/proc/self/status").read_text().splitlines() if x.startswith("VmHWM"))
    return float(line.split()[1]) / 1e6


def main(size: int | None = None) -> None:
    """Print the table."""
    results = Results("bundle")
    side = size or 1200
    for distance in (0.0, 50e-6):
        path, fields = made(side, distance)
        pair = median_seconds(lambda f=fields: scipy.fft.ifft2(scipy.fft.fft2(f[0], workers=-1), workers=-1))
        there, back = path.propagate(fields), path.adjoint(path.propagate(fields))
        off = abs(np.vdot(there, there) - np.vdot(back, fields)) / np.linalg.norm(there) ** 2
        compiled, given = path.function(), jnp.asarray(fields)
        agreement = np.linalg.norm(np.asarray(compiled(given)) - there) / np.linalg.norm(there)
        timed: dict[str, Any] = {
            "propagate": lambda p=path, f=fields: p.propagate(f),
            "adjoint": lambda p=path, f=fields: p.adjoint(f),
            "compiled": lambda c=compiled, g=given: c(g).block_until_ready(),
        }
        spent = {name: median_seconds(function) for name, function in timed.items()}
        results.add(distance=distance, fibrelets=path.bundle.cores, pair_of_ffts=pair, **spent,
                    compiled_off=float(agreement), adjoint_off=float(off))  # fmt: skip
        results.bar(f"one propagation over {1e6 * distance:g} um and the bundle", spent["propagate"], 0.2, "s")
        results.bar("highest memory", in_fresh_process(memory, side, distance, double=False), 1.0, "GB")
    results.save()


if __name__ == "__main__":
    main()
