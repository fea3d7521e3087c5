"""From camera frames of a simulated bench to mode amplitudes, compared with the true ones."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import scipy.sparse

from acquisition import CalibrationPlan, SimulatedBench, calibrate, capture
from fibre import (
    Bundle,
    Calibration,
    CalibrationFields,
    Drift,
    Fibrelets,
    ForwardInverse,
    Images,
    reconstruct,
    recover,
    retrieve_fields,
)
from fibre.amplitudes import CaptureAmplitudes
from fibre.fields import _spots_apart, pattern_groups
from fibre.retrieval.base import RetrievalMethod
from tests.fibre.benches import METHOD, PLAN, SAMPLE
from tests.oracles import jones as oracle


def aligned(fields, bench):
    """Turned by the one phase that all of a calibration shares: the reference spot's own."""
    return fields * np.exp(-1j * np.angle(np.vdot(bench.reference, bench.calibration_fields.reference)))


def truth(bench):
    """True amplitudes of every calibration capture, (captures, 2, m)."""
    x = PLAN.inputs.toarray().reshape(2, 16, -1)
    return np.stack([bench.seen(x[:, :, c]) for c in range(x.shape[2])])


def test_the_amplitudes_are_the_true_ones_to_a_few_per_cent(bench):
    found, true = aligned(bench.calibration_fields.fields, bench), truth(bench)
    error = np.linalg.norm(found - true, axis=(1, 2)) / np.linalg.norm(true, axis=(1, 2))
    assert np.all(error < 0.04)
    assert np.median(error) < 0.015


def test_the_phase_of_v_against_h_and_of_captures_against_each_other_is_right(bench):
    """One phase for everything is free; a wrong sign of the steps, or a piston left over, would show here."""
    found, true = aligned(bench.calibration_fields.fields, bench), truth(bench)
    for p in range(2):
        overlap = np.einsum("ck,ck->c", true[:, p].conj(), found[:, p])
        assert np.abs(np.angle(overlap)).max() < 0.03


def test_the_reference_spot_is_the_true_one(bench):
    found = aligned(bench.calibration_fields.reference, bench)
    assert np.linalg.norm(found - bench.reference) < 0.02 * np.linalg.norm(bench.reference)


def test_the_stated_variance_is_that_of_the_typical_error(bench):
    """Median over median of an exponential variable; errors that all states share stay unseen and are rarer."""
    fields = bench.calibration_fields
    ratio = np.abs(aligned(fields.fields, bench) - truth(bench)) ** 2 / fields.variance
    assert 0.4 < np.median(ratio) / np.log(2) < 2.5
    assert np.min(fields.inflation) >= 1
    assert 0 <= fields.relative_error < 0.03


def test_the_illumination_states_close(bench):
    fields = bench.recording_fields
    null = np.linalg.svd(fields.illumination)[2][2].conj()
    for part, variance in ((fields.fields, fields.variance), (fields.blank, fields.blank_variance)):
        closure = np.abs(np.einsum("n,npk->pk", null, part)) ** 2
        stated = np.einsum("n,npk->pk", np.abs(null) ** 2, variance)
        assert 0.2 < np.median(closure / stated) / np.log(2) < 3


def test_fields_go_with_what_the_captures_were(bench):
    fields, calibration = bench.calibration_fields, bench.calibration
    assert fields.fields.shape == fields.variance.shape == (12, 2, 73)
    np.testing.assert_array_equal(fields.inputs.toarray(), calibration.inputs.toarray())
    np.testing.assert_array_equal(fields.points, calibration.points)
    assert fields.grid == calibration.grid
    np.testing.assert_array_equal(bench.recording_fields.illumination, bench.recording.illumination)


@dataclass(frozen=True)
class Turned(RetrievalMethod):
    """Another method with an arbitrary phase on every field, as intensities leave it."""

    inner: RetrievalMethod

    def solve(self, stack):
        found = self.inner.solve(stack)
        phase = np.random.default_rng(len(found.field)).uniform(-np.pi, np.pi, (len(found.field), 1, 1))
        return replace(found, field=(found.field * np.exp(1j * phase)).astype(np.complex64))


def test_the_phase_of_whole_captures_does_not_matter(bench):
    fibrelets = bench.calibration_fields.fibrelets
    turned = retrieve_fields(bench.recording, Turned(METHOD), fibrelets)
    for name in ("fields", "blank"):
        found, usual = getattr(turned, name), getattr(bench.recording_fields, name)
        # the piston of the reference is what it is: one phase for the whole recording, blank and sample
        phase = np.angle(np.vdot(bench.recording_fields.blank, turned.blank))
        assert np.linalg.norm(found * np.exp(-1j * phase) - usual) < 1e-3 * np.linalg.norm(usual)


@dataclass(frozen=True)
class Tilted(RetrievalMethod):
    """Another method behind a bench whose phase is tilted by ``slope`` radians a metre along the rows."""

    inner: RetrievalMethod
    slope: float

    def solve(self, stack):
        found = self.inner.solve(stack)
        row = (np.arange(found.field.shape[1]) - (found.field.shape[1] - 1) / 2) * stack.pixel_size
        return replace(found, field=(found.field * np.exp(1j * self.slope * row)[:, None]).astype(np.complex64))


def test_a_known_tilt_is_taken_out_of_every_capture(bench):
    fibrelets, slope = bench.calibration_fields.fibrelets, 2e4
    known = Drift(np.zeros(1), np.zeros(1), np.array([[slope, 0.0]]), np.zeros((1, 3, 3)), np.zeros(2),
                  np.zeros(2))  # fmt: skip
    found = retrieve_fields(bench.recording, Tilted(METHOD, slope), fibrelets, drift=known)
    usual = bench.recording_fields
    assert np.linalg.norm(found.blank - usual.blank) < 0.02 * np.linalg.norm(usual.blank)
    tilted = retrieve_fields(bench.recording, Tilted(METHOD, slope), fibrelets)
    assert np.linalg.norm(tilted.blank - usual.blank) > 0.1 * np.linalg.norm(usual.blank)


def test_a_tilt_that_walks_is_followed_by_references_and_closure(bench, tmp_path):
    scene = replace(bench.scene, tilt_walk=3e3, piston_walk=0.3, image_time=0.9)
    moving = SimulatedBench(scene, rng=3)
    plan, sample = replace(PLAN, reference_every=3), replace(SAMPLE, references=3)
    calibration = calibrate(moving, plan, tmp_path / "calibration")
    recording = capture(moving, sample, tmp_path / "sample")
    fibrelets = bench.calibration_fields.fibrelets
    plain = retrieve_fields(calibration, METHOD, fibrelets)
    tracked = retrieve_fields(calibration, METHOD, fibrelets, drift="track")
    assert plain.relative_error > 0.02
    assert tracked.relative_error < 0.5 * plain.relative_error
    lit = [retrieve_fields(recording, METHOD, f, drift=d) for f, d in ((tracked, "track"), (plain, None))]
    assert lit[0].relative_error < 0.5 * lit[1].relative_error
    with pytest.raises(ValueError, match="fibrelets must be the CalibrationFields"):
        retrieve_fields(recording, METHOD, fibrelets, drift="track")
    with pytest.raises(TypeError, match="drift must be Drift"):
        retrieve_fields(recording, METHOD, fibrelets, drift=3.0)


class Stopping(RetrievalMethod):
    """A method that is interrupted at its third batch, until it is told to go on."""

    def __init__(self, inner):
        self.inner, self.batches, self.most = inner, 0, 2

    def __repr__(self):
        return "the same method"

    def solve(self, stack):
        if self.batches == self.most:
            raise KeyboardInterrupt
        self.batches += 1
        return self.inner.solve(stack)


def test_an_interrupted_retrieval_goes_on_where_it_was(bench, tmp_path):
    method, fibrelets = Stopping(METHOD), bench.calibration_fields.fibrelets
    with pytest.raises(KeyboardInterrupt):
        retrieve_fields(bench.calibration, method, fibrelets, folder=tmp_path / "kept")
    method.most = 1000
    found = retrieve_fields(bench.calibration, method, fibrelets, folder=tmp_path / "kept")
    captures = bench.calibration.images.captures + bench.calibration.references.captures
    assert method.batches <= -(-captures // 8) + 1  # none twice; references are a batch of their own
    np.testing.assert_array_equal(found.fields, bench.calibration_fields.fields)
    np.testing.assert_array_equal(found.variance, bench.calibration_fields.variance)
    with pytest.raises(ValueError, match="belongs to another record"):
        retrieve_fields(bench.calibration, METHOD, fibrelets, folder=tmp_path / "kept")


def test_jones_matrices_from_frames_are_the_samples(bench):
    measurement = reconstruct(recover(bench.calibration_fields, ForwardInverse()), bench.recording_fields)
    found = measurement.response @ np.linalg.pinv(measurement.illumination)
    scene = bench.scene.phantom
    true = np.array([oracle.jones(x) for x in np.stack([p.ravel() for p in scene.parameters], 1)])
    true = true.reshape(4, 4, 2, 2) * scene.gain[..., None, None]
    error = np.linalg.norm(found - true, axis=(2, 3)) / np.linalg.norm(true, axis=(2, 3))
    assert np.median(error) < 0.1
    assert np.all(measurement.sigma > 0)


def test_other_records_and_recordings_without_fibrelets_are_refused(bench):
    with pytest.raises(TypeError, match="record must be Calibration or Recording"):
        retrieve_fields(bench.calibration_fields, METHOD)
    with pytest.raises(ValueError, match="fibrelets must be given for a Recording"):
        retrieve_fields(bench.recording, METHOD)


@pytest.fixture(scope="module")
def far_apart():
    """Sixteen points, four of them lit at a time, 32 um apart."""
    bundle = Bundle.hexagonal(radius=36e-6, rng=3)
    plan = CalibrationPlan((4, 4), pitch=16e-6, stride=2)
    launch = bundle.launch(plan.points, 2.5e-6)
    matrix = bundle.columns(scipy.sparse.block_diag([launch, launch])).toarray()
    clean = (matrix @ plan.inputs.toarray()).T.reshape(-1, 2, bundle.cores)

    def images(count):
        stack = np.ones((count, 5, 8, 8))
        return Images(stack, stack, stack > 1, [-1e-5, 1e-5], [0, 2, 4], np.arange(count), 850e-9, 1e-6)

    calibration = Calibration(images(len(clean)), plan.inputs, plan.points, plan.grid, images(1), np.eye(2, 3))
    return bundle, matrix, clean, calibration


def test_the_light_of_spots_that_do_not_meet_is_closed_spot_by_spot(far_apart):
    """Every spot with an unknown phase in every capture, as intensities leave it: one phase a point remains."""
    bundle, matrix, clean, calibration = far_apart
    fibrelets, generator = Fibrelets(bundle.centres, bundle.mode_radius), np.random.default_rng(0)
    spots, dark = _spots_apart(calibration, fibrelets), np.zeros((2, bundle.cores), complex)
    dark[:, 0] = 1e-9  # a reference spot far away
    noise = 1e-3 * np.sqrt((np.abs(clean) ** 2).mean())
    variance = np.full(clean.shape, noise**2)
    errors = []
    for apart in (False, True):
        fields = clean + noise * (generator.standard_normal(clean.shape) + 1j * generator.standard_normal(clean.shape))
        for chosen, states in pattern_groups(calibration):
            owner = spots(chosen)
            assert owner is not None
            phases = generator.uniform(-np.pi, np.pi, (len(chosen), 4))
            turned, most = fields[chosen] * np.exp(1j * phases)[:, None, owner], np.full(variance[chosen].shape, np.inf)
            part = CaptureAmplitudes(turned, variance[chosen], np.zeros(3), most)
            part = part.closed_apart(dark, states, owner) if apart else part.closed(dark, states, None)
            fields[chosen] = part.values
        found = recover(
            CalibrationFields(fields, variance, dark, 1.0, 0.0, fibrelets, calibration.inputs, calibration.points,
                              calibration.grid, np.eye(2, 3)), ForwardInverse(window=40e-6),
        )  # fmt: skip
        z = generator.standard_normal((32, 10)) + 1j * generator.standard_normal((32, 10))
        seen = (found.matrix @ (matrix @ z)).reshape(2, 16, 10)
        true = z.reshape(2, 16, 10)
        seen = seen * np.exp(1j * np.angle((seen.conj() * true).sum((0, 2))))[:, None]
        errors.append(np.linalg.norm(seen - true) / np.linalg.norm(true))
    assert errors[1] < 0.05
    assert errors[0] > 0.3


def test_spots_whose_light_meets_stay_together(bench):
    spots = _spots_apart(bench.calibration, bench.calibration_fields.fibrelets)
    assert spots(pattern_groups(bench.calibration)[0][0]) is None


def test_a_calibration_works_without_some_of_its_captures_and_says_when_it_cannot(standard):
    fields = standard.calibration(0.01, 1)
    z = standard.light()[:, None] * np.ones(2)
    z = z.T.reshape(-1, 1)

    def error(some):
        found = recover(some, ForwardInverse()).matrix @ (standard.matrix @ z)
        return np.linalg.norm(found - z) / np.linalg.norm(z)

    keep = np.ones(len(fields.fields), bool)
    keep[[1, 9, 20]] = False  # one state of three patterns
    fewer = fields.select(keep)
    assert len(fewer.fields) == fewer.inputs.shape[1] == keep.sum()
    assert error(fewer) < 2 * error(fields)
    with pytest.raises(ValueError, match="two states of polarisation"):
        recover(fields.select(np.arange(2, len(keep))), ForwardInverse())
    for bad in ([], [0, 0], [len(keep)], [0.5], np.ones(3, bool)):
        with pytest.raises(ValueError, match="captures must be"):
            fields.select(bad)


def test_a_failed_capture_is_not_believed(bench):
    """The second capture's images are another's: its pattern does not close, and its variance says so."""
    images = bench.calibration.images
    swapped = {n: np.array(getattr(images, n)) for n in ("radiance", "variance", "saturated")}
    for stack in swapped.values():
        stack[1] = stack[7]
    failed = retrieve_fields(replace(bench.calibration, images=replace(images, **swapped)), METHOD)
    usual = bench.calibration_fields
    ratio = failed.variance.mean((1, 2)) / usual.variance.mean((1, 2))
    assert np.all(ratio[:3] > 20)
    assert np.all(ratio[3:] < 2)
