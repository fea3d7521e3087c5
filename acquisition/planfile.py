"""Plans and benches as files: what is to be captured with which devices, in TOML, for ``polinfer acquire``.

In: a path. Out: a plan, and a bench that can be opened. Called by the command line.

    [plan]
    kind = "calibration"            # calibration, pattern or sample
    grid = [18, 18]
    stride = 4
    [plan.views]
    diversity = [-120e-6, 0.0, 120e-6]
    bracket = {longest = 64e-3, factor = 2.0, stop = 0.25e-3}

    [bench]
    kind = "simulated"              # or devices
    seed = 3

    [bench]                         # of devices
    kind = "devices"
    camera = "serial number"
    factory = "my_lab:illumination" # module and function; gets the open camera, returns the Bench
"""

from __future__ import annotations

import importlib
import tomllib
from dataclasses import fields
from pathlib import Path
from typing import Any

from acquisition.contracts import AnyBench
from acquisition.exposure import Bracket
from acquisition.plan import CalibrationPlan, PatternPlan, Plan, SamplePlan, Views

__all__ = ["open_bench", "read_plan"]

PLANS: dict[str, type[Plan]] = {"calibration": CalibrationPlan, "pattern": PatternPlan, "sample": SamplePlan}


def read_plan(path: str | Path) -> tuple[Plan, dict[str, Any]]:
    """The plan of a file, and what it says of the bench.

    Raises FileNotFoundError; ValueError for a file that is no TOML, or an entry that is unknown, naming it.
    """
    path = Path(path)
    try:
        text = tomllib.loads(path.read_text())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is no TOML file: {error}.") from error
    unknown = sorted(set(text) - {"plan", "bench"})
    if unknown or not isinstance(text.get("plan"), dict) or not isinstance(text.get("bench", {}), dict):
        raise ValueError(f"{path} must hold the tables plan and bench, got {', '.join(text) or 'nothing'}.")
    return _plan(path, dict(text["plan"])), dict(text.get("bench", {"kind": "simulated"}))


def _plan(path: Path, given: dict[str, Any]) -> Plan:
    kind = given.pop("kind", "calibration")
    if kind not in PLANS:
        raise ValueError(f"{path}: plan.kind must be one of {', '.join(PLANS)}, got {kind!r}.")
    if "views" in given:
        views = _known(path, "plan.views", dict(given["views"]), Views)
        if "bracket" in views:
            views["bracket"] = Bracket(**_known(path, "plan.views.bracket", dict(views["bracket"]), Bracket))
        given["views"] = Views(**views)
    if "grid" in given:
        given["grid"] = tuple(given["grid"])
    return PLANS[kind](**_known(path, "plan", given, PLANS[kind]))


def _known(path: Path, table: str, given: dict[str, Any], kind: type) -> dict[str, Any]:
    names = [f.name for f in fields(kind)]
    unknown = sorted(set(given) - set(names))
    if unknown:
        raise ValueError(f"{path}: {table} has no {unknown[0]!r}; it may hold {', '.join(names)}.")
    return given


def open_bench(given: dict[str, Any], plan: Plan) -> AnyBench:
    """The bench of a file. The simulated one is the demo's, as large as the plan's grid.

    A bench of devices is made by a function of yours, ``factory = "module:function"``, since no two laboratories have
    the same optics: it is called with the camera that has the stated serial number, and returns an
    :class:`acquisition.Bench`. Raises ValueError for entries that are missing or unknown, and what opening raises.
    """
    kind = given.get("kind", "simulated")
    allowed = {"simulated": {"kind", "seed"}, "devices": {"kind", "camera", "factory"}}
    if kind not in allowed or set(given) - allowed[kind]:
        raise ValueError(
            f"bench.kind must be simulated (with seed) or devices (with camera and factory), got {given!r}."
        )
    if kind == "simulated":
        from acquisition.bench.simulator import SimulatedBench
        from acquisition.demo import demo_scene

        seed = int(given.get("seed", 0))
        grid = getattr(plan, "grid", (18, 18))
        return SimulatedBench(demo_scene(seed, grid), rng=seed)
    from acquisition.usb.camera import Usb3VisionCamera
    from acquisition.worker import WorkerCamera

    for name in ("camera", "factory"):
        if not isinstance(given.get(name), str):
            raise ValueError(f"bench.{name} must be text where bench.kind is devices, got {given.get(name)!r}.")
    module, _, function = given["factory"].partition(":")
    if not module or not function:
        raise ValueError(f"bench.factory must be module:function, got {given['factory']!r}.")
    make = getattr(importlib.import_module(module), function)
    opener = f"{Usb3VisionCamera.__module__}:{Usb3VisionCamera.__name__}"
    camera = WorkerCamera.open(opener, given["camera"])
    try:
        bench: AnyBench = make(camera)
    except BaseException:
        camera.close()
        raise
    return bench
