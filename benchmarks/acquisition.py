"""Cameras over USB in software: frames a second and memory; merging a bracket; its error against the least possible.

A camera of 1200 x 1200 pixels and 8 bits behind pyusb's in-process backend: every line of the driver runs, libusb and
wires do not. The merge: eight exposures of 1200 x 1200. ``--full``: 10,000 frames instead of 500.
"""

from __future__ import annotations

import resource
import time

import numpy as np

from acquisition import InverseVariance, LongestUnsaturated, Usb3VisionCamera, merge_exposures
from acquisition.twins.backend import TwinBackend
from acquisition.twins.camera import CameraTwin
from benchmarks.results import Results, alternating_seconds

SIDE = 1200
GAIN, READ, DARK, FULL = 2.0, 3.0, 20.0, 4095
TIMES = 0.1 / 2.0 ** np.arange(9)


def capture(results: Results, count: int) -> None:
    """Frames in a row, and one by one by trigger."""
    image = np.random.default_rng(0).integers(0, 256, (SIDE, SIDE), np.uint8)
    twin = CameraTwin(shape=(SIDE, SIDE), scene=lambda *_: image)
    with Usb3VisionCamera.open("TWIN-0001", TwinBackend(twin)) as camera:
        camera.snap(0.01)
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        start, right = time.perf_counter(), 0
        for frame in camera.frames(count):
            right += int(frame.counts[0, 0] == image[0, 0]) * int(frame.counts[-1, -1] == image[-1, -1])
        spent = time.perf_counter() - start
        grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1e3
        start = time.perf_counter()
        for _ in range(100):
            camera.snap(0.01)
        snapped = (time.perf_counter() - start) / 100
    buffer = np.empty_like(image)
    copies = alternating_seconds({"copy": lambda: np.copyto(buffer, image)}, 50)["copy"]
    rate = count * image.nbytes / spent / 1e6
    results.add(frames=count, complete=right, megabytes_a_second=rate,
                frame_over_one_copy=spent / count / np.median(copies), milliseconds_a_trigger=1e3 * snapped,
                memory_grown_mb=grown)  # fmt: skip
    results.bar("capture in a row", rate, 200, "MB/s", at_least=True)
    results.bar("frames lost", count - right, 0)
    results.bar("memory grown", grown, 20, "MB")


def merging(results: Results) -> None:
    """Time of a merge; error and stated variance over five decades."""
    rng = np.random.default_rng(1)
    scene = 10 ** rng.uniform(2, 7, (SIDE, SIDE))
    times = 0.064 / 2.0 ** np.arange(8)
    electrons = rng.poisson(scene * times[:, None, None]) + 5 * rng.standard_normal((8, SIDE, SIDE))
    frames = np.clip(np.rint(electrons / 40), 0, 255).astype(np.uint8)
    rules = {"inverse variance": InverseVariance(40.0, 5.0), "longest unsaturated": LongestUnsaturated(40.0, 5.0)}
    for rule in rules.values():
        merge_exposures(frames, times, 255, rule)
    spent = alternating_seconds(
        {name: (lambda r=rule: merge_exposures(frames, times, 255, r)) for name, rule in rules.items()}, 15
    )
    for name, seconds in spent.items():
        results.add(rule=name, merge_milliseconds=1e3 * float(np.median(seconds)))
    results.bar("merge of 8 x 1200 x 1200", 1e3 * float(np.median(spent["inverse variance"])), 30, "ms")
    bound_over, stated_over = [], []
    for radiance in (200.0, 1e3, 3e3, 3e4, 1.1e5, 2.2e5, 4.5e5, 1.8e6, 1.4e7, 1.85e7):  # none straddles saturation
        mean = (radiance + DARK) * TIMES[:, None, None]
        electrons = rng.poisson(np.broadcast_to(mean, (9, 200, 500))) + READ * rng.standard_normal((9, 200, 500))
        counts = np.clip(np.rint(electrons / GAIN), 0, FULL).astype(np.uint16)
        level = mean[:, 0, 0]
        information = np.sum(
            (TIMES**2 / (level + READ**2 + GAIN**2 / 12))[level / GAIN + 5 * np.sqrt(level) / GAIN < FULL]
        )
        row = {"radiance": float(radiance), "least_deviation": float(information**-0.5)}
        for name, rule in {
            "ours": InverseVariance(GAIN, READ, DARK),
            "paper": LongestUnsaturated(GAIN, READ, DARK),
        }.items():
            merged = merge_exposures(counts, TIMES, FULL, rule)
            error2 = float(np.mean((merged.radiance - radiance) ** 2))
            row[f"{name}_over_least"] = np.sqrt(error2 * information)
            row[f"{name}_stated_over_true"] = float(np.sqrt(merged.variance.mean() / error2))
        bound_over.append(row["ours_over_least"])
        stated_over.append(abs(row["ours_stated_over_true"] ** 2 - 1))
        results.add(**row)
    results.bar("deviation over the Cramer-Rao bound, worst of five decades", max(bound_over), 1.05)
    results.bar("stated variance off by, worst", max(stated_over), 0.1)


def main(full: bool = False) -> None:
    """Print the tables."""
    results = Results("acquisition")
    capture(results, 10_000 if full else 500)
    merging(results)
    results.save()


if __name__ == "__main__":
    main()
