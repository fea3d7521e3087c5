"""A bench small enough for many tests: 73 fibrelets, 64 x 64 pixels, 4 x 4 points, a few views."""

from dataclasses import replace

from acquisition import Bracket, CalibrationPlan, CameraModel, SamplePlan, Scene, SimulatedBench, Views
from fibre import Bundle
from polinfer import phantoms

BUNDLE = Bundle.hexagonal(radius=20e-6, rng=0)
VIEWS = Views(diversity=(-4e-5, 0.0, 4e-5), steps=(0.0, 2.0, 4.0), bracket=Bracket(64e-3, 4.0, 1e-3))
CAMERA = CameraModel(shape=(64, 64), pixel_size=0.72e-6, gain=4.0, read_noise=3.0, bits=12)
SCENE = Scene(
    BUNDLE, phantoms.lesion((4, 4), rng=0), CAMERA, spot_power=2e7, reference=(0.0, 16e-6), illumination_waist=3e-5
)
PLAN = CalibrationPlan((4, 4), stride=2, reference_every=5, views=VIEWS)
SAMPLE = SamplePlan(views=VIEWS, references=1)


def bench(seed=7, camera=None, **changes):
    """The small bench, with some settings of its scene or of its camera changed."""
    return SimulatedBench(replace(SCENE, camera=replace(CAMERA, **(camera or {})), **changes), rng=seed)
