"""A bench that exists only in numbers, behind the same contract as a real one."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, fields
from typing import Any

import numpy as np
import scipy.ndimage

from acquisition.bench.modulators import defocused, shown_spots
from acquisition.bench.scene import Scene
from acquisition.contracts import Frame
from acquisition.exposure import InverseVariance, MergeRule
from acquisition.plan import Step, Views
from polinfer import RetarderFirst
from polinfer.checks import as_generator, one_of_types
from polinfer.orderings.on_host import jones_on_host

__all__ = ["SimulatedBench"]

WALK = 1  # the seed of the drift, beside the bench's own


class SimulatedBench:
    """The bench of a :class:`Scene`: hologram -> sample -> bundle -> second modulator -> camera.

    Frames depend on (seed, step, view, exposure) and, through the drift if there is one, on the time, so an interrupted
    run that is resumed sees the same frames. Light meets the retarder of the phantom first.
    """

    def __init__(self, scene: Scene, rng: int | np.random.Generator | None = None) -> None:
        one_of_types("scene", scene, (Scene,), "pass Scene(bundle, phantom, ...).")
        generator, seed = as_generator(rng)
        self.scene = scene
        self.seed = int(generator.integers(1 << 62)) if seed is None else seed
        self.wavelength = scene.bundle.wavelength
        self.pixel_size = scene.camera.pixel_size
        self.full_scale = scene.camera.full_scale
        self.merge_rule: MergeRule = InverseVariance(scene.camera.gain, scene.camera.read_noise)
        self.registration = np.array([[1.0, 0, 0], [0, 1.0, 0]])
        self._step: Step | None = None
        self._rates: np.ndarray | None = None
        self._clock, self._view, self._block = 0.0, -1, -1
        self._sample = self._sample_field()

    def describe(self) -> dict[str, Any]:
        """See :class:`acquisition.contracts.AnyBench`."""
        settings = {
            f.name: getattr(self.scene, f.name) for f in fields(Scene) if f.name not in ("bundle", "phantom", "camera")
        }
        settings |= {name: asdict(settings[name]) for name in ("hologram", "lens") if settings[name] is not None}
        bundle, coupling, phantom = self.scene.bundle, self.scene.bundle.coupling, self.scene.phantom
        digest = hashlib.sha256()
        # the parameters and not the Jones matrices, whose last digits are the compiler's
        for part in (
            *phantom.parameters,
            1.0 if phantom.gain is None else phantom.gain,
            bundle.centres,
            bundle.mode_radius,
            bundle.distal_centres,
            coupling.data,
            coupling.indices,
        ):
            digest.update(np.ascontiguousarray(part).tobytes())
        settings["wavelength"] = self.wavelength
        described = {"bench": "simulated", "seed": self.seed, "scene": settings, "contents": digest.hexdigest()}
        return json.loads(json.dumps(described | {"camera": asdict(self.scene.camera)}))

    def time(self) -> float:
        """Seconds; the simulated clock advances by each exposure, and by the scene's time for each image."""
        return self._clock

    def continue_from(self, seconds: float) -> None:
        """See :class:`acquisition.contracts.AnyBench`."""
        self._clock = max(self._clock, seconds)

    def drift(self, seconds: float) -> tuple[float, tuple[float, float]]:
        """Piston, radians, and tilt, radians a metre along (row, column), at a time: random walks of the seed."""
        scene = self.scene
        if scene.piston_walk == 0 and scene.tilt_walk == 0:
            return 0.0, (0.0, 0.0)
        whole = int(seconds)
        steps = np.random.default_rng([self.seed, WALK]).standard_normal((whole + 1, 3))
        walk = steps[:whole].sum(0) + np.sqrt(seconds - whole) * steps[whole]
        return float(scene.piston_walk * walk[0]), (float(scene.tilt_walk * walk[1]), float(scene.tilt_walk * walk[2]))

    def prepare(self, step: Step, views: Views, illumination: np.ndarray, points: np.ndarray | None) -> None:
        """See :class:`acquisition.contracts.AnyBench`."""
        piston, tilt = self.drift(self._clock)
        turned = np.exp(1j * (piston + self.scene.bundle.centres @ tilt))
        self._rates = self._views(self.amplitudes(step, illumination, points) * turned, views, step)
        self._step, self._view = step, -1

    def amplitudes(self, step: Step, illumination: np.ndarray, points: np.ndarray | None) -> np.ndarray:
        """The truth of a capture: mode amplitudes at the proximal facet without drift, complex (2, m), in units of a
        calibration spot; times the root of the scene's ``spot_power`` and of the camera's quantum efficiency they are
        in sqrt(photo-electrons/s). Arguments as for :meth:`prepare`. ValueError without ``points`` for spots."""
        scene = self.scene
        state = illumination[:, step.state]
        spot = scene.bundle.launch(np.array([scene.reference]), scene.spot_waist)
        launched = scene.reference_amplitude * np.outer([1, 1], spot.toarray()[:, 0]) / np.sqrt(2) + 0j
        if step.kind == "spots":
            if points is None:
                raise ValueError("points must be given for a step that lights spots.")
            launched += (scene.bundle.launch(points, scene.spot_waist) @ self._spots(step, state, points).T).T
        elif step.kind in ("blank", "sample"):
            places, light, jones, waist = self._sample
            field = self._arms(state, places)
            if step.kind == "sample":
                field = np.einsum("kij,jk->ik", jones, field)
            launched += (scene.bundle.launch(places, waist) @ (light * field).T).T
        return np.asarray(scene.bundle.transmit(launched))

    def expose(self, view: int, exposure: float) -> Frame:
        """See :class:`acquisition.contracts.AnyBench`."""
        if self._rates is None or self._step is None:
            raise RuntimeError("prepare a step before exposing.")
        camera = self.scene.camera
        began, self._block = self._clock, self._block + 1
        self._clock += exposure + (self.scene.image_time if view != self._view else 0.0)
        self._view = view
        mean = self._rates[view] * exposure
        key = hashlib.sha256(f"{self._step.id}|{view}|{exposure!r}".encode()).digest()
        generator = np.random.default_rng([self.seed, *np.frombuffer(key, np.uint32).tolist()])
        electrons = _shot_noise(mean, generator) if camera.shot_noise else mean
        if camera.read_noise:
            electrons = electrons + camera.read_noise * generator.standard_normal(mean.shape, np.float32)
        counts = np.clip(np.rint(electrons / camera.gain), 0, camera.full_scale)
        return Frame(counts.astype(np.uint8 if camera.bits <= 8 else np.uint16), self._block, began, exposure)

    def make_safe(self) -> None:
        """See :class:`acquisition.contracts.AnyBench`: there is no light to turn off."""

    def _arms(self, state: np.ndarray, points: np.ndarray) -> np.ndarray:
        """The state (2,) as it is at distal points, complex (2, p)."""
        field = np.repeat(state[:, None], len(points), 1)
        if any(self.scene.misalignment):
            field = field * np.exp(1j * np.outer([0, 1], self.scene.between_arms(points)))
        return field

    def _spots(self, step: Step, state: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Complex amplitudes (2, p) of the spots that a step lights."""
        scene, lit = self.scene, list(step.points)
        light = np.zeros((2, len(points)), complex)
        light[:, lit] = np.outer(state, step.light)
        if scene.hologram is not None:
            light = shown_spots(scene.hologram, points, light, scene.pitch, self.wavelength, scene.image_time)
        return light * self._arms(np.ones(2), points)

    def _sample_field(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        """Places, light, Jones matrices and spot size of the sample, which is finer than the grid if the scene says."""
        scene = self.scene
        parameters, gain = scene.phantom.parameters, scene.phantom.gain
        jones = jones_on_host(RetarderFirst(), parameters)
        if gain is not None:
            jones = jones * np.asarray(gain)[..., None, None]
        rows, columns = jones.shape[:2]
        fine = scene.sample_oversampling
        index = [(np.arange(n * fine) + 0.5) / fine - 0.5 for n in (rows, columns)]
        grid = np.stack(np.meshgrid(*index, indexing="ij"))
        elements = [
            scipy.ndimage.map_coordinates(jones[..., i, j], grid, order=3, mode="nearest")
            for i in (0, 1)
            for j in (0, 1)
        ]
        finer = np.stack(elements, -1).reshape(-1, 2, 2)
        middle = (np.array([rows, columns]) - 1) / 2
        places = (grid.reshape(2, -1).T - middle) * scene.pitch
        waist = scene.spot_waist if fine == 1 else max(scene.pitch / fine, 0.6 * scene.spot_waist)
        # a lattice of unit-power Gaussians of waist w and spacing h adds up to a flat field in proportion to w / h^2
        share = (scene.spot_waist / waist) / fine**2
        light = scene.illumination * share * np.exp(-(places**2).sum(1) / scene.illumination_waist**2)
        return places, light, finer, waist

    def _views(self, amplitudes: np.ndarray, views: Views, step: Step) -> np.ndarray:
        """Photo-electrons per second of every view, real (image, y, x)."""
        scene, camera = self.scene, self.scene.camera
        key = hashlib.sha256(f"{step.id}|steps".encode()).digest()
        generator = np.random.default_rng([self.seed, *np.frombuffer(key, np.uint32).tolist()])
        distances = np.array([0.0, *(d * (1 + scene.focus_error) + scene.focus_offset for d in views.diversity)])
        distances[0] = scene.focus_offset
        if scene.lens is None:
            seen = scene.bundle.image(amplitudes, camera.shape, camera.pixel_size, distances, scene.oversampling)
        else:
            step_size = camera.pixel_size / scene.oversampling
            focus = scene.bundle.image(amplitudes, camera.shape, camera.pixel_size, 0.0, scene.oversampling)
            seen = defocused(scene.lens, focus, distances, self.wavelength, step_size, scene.image_time)
        rates = [np.abs(seen[1 + i, 0]) ** 2 for i in range(len(views.diversity))]
        errors = scene.step_error * generator.standard_normal(len(views.steps))
        for phase in self._steps(views) + errors:
            rates.append(np.abs(seen[0, 0] + np.exp(1j * phase) * seen[0, 1]) ** 2 / 2)
        fine = scene.oversampling
        binned = np.stack(rates).reshape(len(rates), camera.shape[0], fine, camera.shape[1], fine).mean((2, 4))
        return scene.spot_power * camera.quantum_efficiency * camera.pixel_size**2 * binned

    def _steps(self, views: Views) -> np.ndarray:
        """Phase steps as the lens's modulator shows them, (k,) radians."""
        lens, steps = self.scene.lens, np.array(views.steps)
        if lens is None:
            return steps
        # a phase that is the same in all pixels: no crosstalk
        shown, last = [], 0.0
        for grey in lens.addressed(steps):
            last = grey + lens.left(self.scene.image_time) * (last - grey)
            shown.append(last)
        return np.array(shown)


def _shot_noise(mean: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Poisson photo-electrons; from 50 upwards by the normal limit, whose skew (0.14) no rounding to counts shows."""
    electrons = (mean + np.sqrt(mean) * generator.standard_normal(mean.shape, np.float32)).astype(np.float32)
    few = mean < 50
    electrons[few] = generator.poisson(mean[few])
    return electrons
