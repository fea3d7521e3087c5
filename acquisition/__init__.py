"""Capture: benches, plans, exposures, runs; and a bench that is simulated whole."""

from .bench.scene import CameraModel, Scene
from .bench.simulator import SimulatedBench
from .contracts import AnyBench as Bench
from .exposure import Bracket, InverseVariance, LongestUnsaturated, Merged, merge_exposures
from .plan import CalibrationPlan, GridPlan, PatternPlan, SamplePlan, Step, Timing, Views, elliptical_states
from .run import calibrate, capture

__all__ = [
    "Bench",
    "Bracket",
    "CalibrationPlan",
    "CameraModel",
    "GridPlan",
    "InverseVariance",
    "LongestUnsaturated",
    "Merged",
    "PatternPlan",
    "SamplePlan",
    "Scene",
    "SimulatedBench",
    "Step",
    "Timing",
    "Views",
    "calibrate",
    "capture",
    "elliptical_states",
    "merge_exposures",
]
