"""A run that is killed while it writes: nothing is lost and nothing doubled."""

import hashlib
import json
import os
import signal

import numpy as np
import pytest

from acquisition import Frame, InverseVariance
from acquisition.run import _execute
from tests.acquisition.benches import PLAN, VIEWS


class Quick:
    """A bench that costs nothing: every frame says which it is."""

    wavelength, pixel_size, full_scale = 850e-9, 1e-6, 255
    merge_rule, registration = InverseVariance(1.0, 1.0), np.eye(2, 3)

    def __init__(self):
        self.clock, self.step = 0.0, None

    def describe(self):
        return {"bench": "quick"}

    def prepare(self, step, views, illumination, points):
        self.step = step

    def expose(self, view, exposure):
        self.clock += exposure
        number = int(hashlib.sha256(f"{self.step.id}|{view}|{exposure}".encode()).hexdigest(), 16)
        return Frame(np.full((2, 3), number % 250, np.uint8), 0, self.clock, exposure)

    def time(self):
        return self.clock

    def continue_from(self, seconds):
        self.clock = max(self.clock, seconds)

    def make_safe(self):
        pass


def killed_at(point, after, folder):
    """A run in a process of its own that is killed at its ``point``-th fsync, before or after it; False: it ended."""
    child = os.fork()
    if child == 0:
        real, count = os.fsync, 0

        def fsync(descriptor):
            nonlocal count
            if count == point and not after:
                os.kill(os.getpid(), signal.SIGKILL)
            real(descriptor)
            if count == point and after:
                os.kill(os.getpid(), signal.SIGKILL)
            count += 1

        os.fsync = fsync
        try:
            _execute(Quick(), PLAN, folder, PLAN.points, False, None)
        finally:
            os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL


@pytest.mark.filterwarnings("ignore:.*fork.*")
@pytest.mark.parametrize("after", [False, True])
def test_killed_at_any_fsync_nothing_is_lost_and_nothing_doubled(after, tmp_path, monkeypatch):
    """Killed at some fsync (every one where POLINFER_KILLS is set) of a new run, and of one that was killed before."""
    synced, real = [], os.fsync
    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", lambda descriptor: (synced.append(descriptor), real(descriptor)))
        _execute(Quick(), PLAN, tmp_path / "whole", PLAN.points, False, None)
    every = range(len(synced))
    points = every if os.environ.get("POLINFER_KILLS") else every[:: len(every) // 9]
    kills, survivor = 0, tmp_path / "one after the other"
    for point in points:
        for folder in (tmp_path / f"at {point}", survivor):
            kills += killed_at(point, after, folder)
    assert kills >= len(points)
    for folder in [*(tmp_path / f"at {point}" for point in points), survivor]:
        store = _execute(Quick(), PLAN, folder, PLAN.points, False, None)
        assert {step.id for step in PLAN.captures} <= set(store.done)
        for identity in store.done:
            frames, exposures = store.load(identity)  # checks the hash
            assert len(frames) == len(VIEWS)
            for view, (stack, times) in enumerate(zip(frames, exposures, strict=True)):
                for frame, exposure in zip(stack, times, strict=True):
                    number = int(hashlib.sha256(f"{identity}|{view}|{exposure}".encode()).hexdigest(), 16)
                    assert np.all(frame == number % 250)
        lines = [json.loads(line) for line in (folder / "manifest.jsonl").read_text().splitlines()[1:]]
        current = [line["id"] for line in lines if not line.get("void")]
        voided = [line["id"] for line in lines if line.get("void")]
        assert sorted(current) == sorted([*store.done, *voided])  # every capture counts once
