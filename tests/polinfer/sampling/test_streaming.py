"""Summaries in parts: the same as of the whole, also when interrupted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from polinfer import Ensemble, Gibbs, InferredNoise, Measurement, Model, Parameters, Status, sample, simulate, summarise
from polinfer.sampling import streaming

from ..scenes import BALANCED


def measured(shape: tuple[int, ...]) -> Measurement:
    rng = np.random.default_rng(3)
    truth = Parameters(*(np.asarray(Model().priors[n].sample(rng, shape)) for n in Parameters._fields))
    data = simulate(Model(), truth, BALANCED, 0.05, rng=2)
    mask = np.ones(shape, bool)
    mask[1, 2:] = False
    response = data.response.copy()
    response[4, 4] = np.nan
    return replace(data, mask=mask, response=response)


@pytest.fixture
def small_parts(monkeypatch):
    """Seven pixels in a part."""
    monkeypatch.setattr(streaming, "LEAST", 7)
    monkeypatch.setattr(streaming, "VALUES", 1)


def same(one, other):
    for name in ("mean", "std", "low", "high"):
        for a, b in zip(getattr(one, name), getattr(other, name), strict=True):
            # blocks of another size: fits and sums end in other last digits
            np.testing.assert_allclose(a, b, atol=1e-6)
    np.testing.assert_array_equal(one.status, other.status)
    np.testing.assert_allclose(one.ess, other.ess, rtol=1e-5)


def test_parts_give_the_summary_of_all_draws(small_parts):
    data = measured((6, 8))
    whole = sample(Model(), data, Gibbs(evidence=False), chains=2, draws=100, rng=5).summary(0.9)
    parts = summarise(Model(), data, chains=2, draws=100, level=0.9, rng=5)
    same(parts, whole)
    assert parts.level == 0.9
    assert (parts.status[1, 2:] == int(Status.MASKED)).all()
    assert parts.status[4, 4] == int(Status.NON_FINITE)
    assert np.isfinite(parts.mean.retardance[parts.status & 3 == 0]).all()


def test_an_interrupted_call_goes_on_and_a_folder_belongs_to_one_call(small_parts, tmp_path, monkeypatch):
    data, folder = measured((6, 8)), tmp_path / "parts"

    def call(**other):
        return summarise(Model(), data, **({"chains": 2, "draws": 100, "rng": 5, "folder": folder} | other))

    whole, drawn = summarise(Model(), data, chains=2, draws=100, rng=5), []
    summary = streaming.summarise_draws

    def stop(*arguments):
        drawn.append(arguments)
        if len(drawn) == 4:
            raise KeyboardInterrupt
        return summary(*arguments)

    monkeypatch.setattr(streaming, "summarise_draws", stop)
    with pytest.raises(KeyboardInterrupt):
        call()
    assert len(list(folder.glob("part_*.nc"))) == 3
    same(call(), whole)
    assert len(drawn) == 4 + 4  # seven parts, of which three were there
    same(call(), whole)
    assert len(drawn) == 8
    with pytest.raises(ValueError, match="belongs to another model, measurement, seed or setting"):
        call(rng=6)
    with pytest.raises(ValueError, match="folder needs a seed"):
        call(rng=None)
    (folder / "part_000002.nc").write_bytes(b"nothing")
    with pytest.raises(ValueError, match="part_000002"):
        call()
    with pytest.raises(ValueError, match="holds other files"):
        call(folder=tmp_path)


def test_what_has_no_parts_is_refused_and_ensembles_are_taken(small_parts):
    data = measured((6, 8))
    with pytest.raises(ValueError, match="one sigma ties all pixels"):
        summarise(Model(noise=InferredNoise(2.0, 0.1, "frame")), replace(data, sigma=None))
    with pytest.raises(ValueError, match="level"):
        summarise(Model(), data, level=1.0)
    few = np.zeros((6, 8), bool)
    few[0, 6:] = few[1, 0] = True
    short = Ensemble(walkers=10, warmup=5, thin=1)
    found = summarise(Model(), replace(data, mask=few), short, chains=2, draws=20, rng=1)
    same(found, sample(Model(), replace(data, mask=few), short, chains=2, draws=20, rng=1).summary())
