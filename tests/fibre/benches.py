"""A simulated bench small enough to go from frames to Jones data in seconds: 73 fibrelets, 4 x 4 points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from acquisition import (
    Bracket,
    CalibrationPlan,
    CameraModel,
    SamplePlan,
    Scene,
    SimulatedBench,
    Views,
    calibrate,
    capture,
)
from fibre import (
    Bundle,
    Calibration,
    CalibrationFields,
    Fibrelets,
    GerchbergSaxton,
    Recording,
    RecordingFields,
    load,
    retrieve_fields,
    save,
)
from polinfer import phantoms

VIEWS = Views(diversity=(-5e-5, -2.5e-5, 0.0, 2.5e-5, 5e-5), bracket=Bracket(64e-3, 4.0, 1e-3))
PLAN = CalibrationPlan((4, 4), pitch=6e-6, stride=2, reference_every=6, views=VIEWS)
SAMPLE = SamplePlan(views=VIEWS, references=1)
METHOD = GerchbergSaxton(iterations=50)


@dataclass(frozen=True)
class Small:
    """The bench's scene, its captures, and what was retrieved from them."""

    scene: Scene
    calibration: Calibration
    recording: Recording
    calibration_fields: CalibrationFields
    recording_fields: RecordingFields

    def seen(self, spots):
        """True amplitudes (2, m), in sqrt(photo-electrons/s), of distal fields (2, p) at the points."""
        bundle, launch = self.scene.bundle, self.scene.bundle.launch(PLAN.points, self.scene.spot_waist)
        return bundle.transmit((launch @ spots.T).T) * np.sqrt(self.scene.spot_power)

    @property
    def reference(self):
        """True amplitudes of the reference spot, (2, m)."""
        bundle = self.scene.bundle
        spot = bundle.launch(np.array([self.scene.reference]), self.scene.spot_waist).toarray()[:, 0]
        return bundle.transmit(np.stack([spot, spot]) / np.sqrt(2)) * np.sqrt(self.scene.spot_power)


def small(folder):
    """Capture and retrieve everything once, in ``folder``; what is there already is taken from it."""
    bundle = Bundle.hexagonal(radius=20e-6, mode_spread=0.0, rng=0)
    camera = CameraModel(shape=(96, 96), pixel_size=0.72e-6, gain=4.0, read_noise=3.0, bits=12)
    scene = Scene(
        bundle, phantoms.lesion((4, 4), rng=0), camera, pitch=PLAN.pitch, spot_power=1e8, reference=(0.0, 17e-6),
        illumination=0.5, illumination_waist=3e-5,
    )  # fmt: skip
    bench = SimulatedBench(scene, rng=3)
    calibration, recording = calibrate(bench, PLAN, folder / "calibration"), capture(bench, SAMPLE, folder / "sample")
    fibrelets = Fibrelets(bundle.centres, 1.6e-6)

    def fields(record, name):
        path = folder / name
        return load(path) if path.exists() else load(save(retrieve_fields(record, METHOD, fibrelets), path))

    return Small(scene, calibration, recording, fields(calibration, "calibration.nc"), fields(recording, "sample.nc"))
