"""Fits of records on disk, block by block: the numbers of one fit, whatever happens on the way."""

import json
import os
import pickle
import signal
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
import zarr

import polinfer
from polinfer import (
    ComplexGain,
    InferredNoise,
    Measurement,
    Model,
    Parameters,
    Status,
    TiltPlane,
    Window,
    chunked,
    fit_stored,
    save,
)
from polinfer.chunked import Stored
from tests.clusters import workers

STATES = np.stack([np.ones(3), np.exp(2j * np.pi * np.arange(3) / 3)]) / np.sqrt(2)


def data(shape=(12, 10), seed=0, **changes):
    rng = np.random.default_rng(seed)
    truth = Parameters(*(rng.uniform(0.2, 0.9, shape) for _ in range(5)))
    made = polinfer.simulate(Model(), truth, STATES, sigma=0.02, rng=seed)
    sigma = rng.uniform(0.015, 0.03, shape)
    return replace(made, sigma=sigma, **changes)


def same(found, expected, but=()):
    for name in ("status", "degrees_of_freedom"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    for name in ("covariance", "log_posterior", "log_evidence", "sigma", "gain", "chi_square"):
        if name not in but and getattr(expected, name) is not None:
            np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-6, atol=1e-9)
    for part in ("parameters", "std"):
        for one, other in zip(getattr(found, part), getattr(expected, part), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(
    ("model", "shape", "pixels"),
    [
        (Model(), (12, 10), 30),
        (Model(), (12, 10), 7),  # less than a row: one row
        (Model(gain=ComplexGain(1.0)), (3, 6, 5), 60),  # two frames of a series
        (Model(neighbours=Window(3, 5)), (12, 10), 40),
        (Model(neighbours=Window(5, 3)), (2, 9, 8), 24),  # blocks that cut frames
        (Model(fixed={"diattenuation": 0.0}), (12, 10), 1000),
    ],
    ids=["rows", "row by row", "frames", "window", "window in a series", "one block"],
)
def test_blocks_are_fitted_as_the_whole(tmp_path, model, shape, pixels):
    mask = np.ones(shape, bool)
    mask.reshape(-1, shape[-1])[:4] = False  # a whole block, for some
    measurement = data(shape, mask=mask)
    path = fit_stored(model, save(measurement, tmp_path / "data.zarr"), tmp_path / "fit.zarr", pixels)
    assert path == tmp_path / "fit.zarr"
    found = polinfer.load(path)
    same(found, polinfer.fit(model, measurement))
    assert found.model == model
    assert np.all(found.status[~mask] == Status.MASKED)
    assert np.all(np.isnan(found.parameters.retardance[~mask]))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["data.zarr", "fit.zarr"]


def test_covariance_is_left_out_where_it_is_not_wanted(tmp_path):
    measurement = data()
    source = save(measurement, tmp_path / "data.zarr")
    path = fit_stored(Model(), source, tmp_path / "fit.zarr", 30, covariance=False)
    found = polinfer.load(path)
    assert np.all(np.isnan(found.covariance))
    same(found, polinfer.fit(Model(), measurement), but=("covariance",))
    whole = fit_stored(Model(), source, tmp_path / "whole.zarr", 30)
    sizes = [sum(f.stat().st_size for f in p.rglob("*") if f.is_file()) for p in (path, whole)]
    assert sizes[0] < 0.7 * sizes[1]


def test_a_store_is_made_of_blocks_and_read_in_others(tmp_path):
    whole = data((6, 8))
    store = Stored.create(tmp_path / "a.zarr", replace(whole, response=whole.response[:2], sigma=whole.sigma[:2]),
                          (6, 8), (2, 8))  # fmt: skip
    for row in range(0, 6, 2):
        part = replace(whole, response=whole.response[row : row + 2], sigma=whole.sigma[row : row + 2])
        store.write((slice(row, row + 2), slice(0, 8)), part)
    again = polinfer.load(tmp_path / "a.zarr")
    np.testing.assert_array_equal(again.response, whole.response)
    np.testing.assert_array_equal(again.illumination, whole.illumination)
    part = Stored(tmp_path / "a.zarr").read((slice(1, 5), slice(3, 4)))
    np.testing.assert_array_equal(part.response, whole.response[1:5, 3:4])
    np.testing.assert_array_equal(part.sigma, whole.sigma[1:5, 3:4])
    np.testing.assert_array_equal(part.illumination, whole.illumination)


def test_an_interrupted_fit_goes_on(tmp_path, monkeypatch):
    measurement = data()
    source, target = save(measurement, tmp_path / "data.zarr"), tmp_path / "fit.zarr"
    blocks, real = [], chunked._fitted

    def stops(common, block):
        if len(blocks) == 3:
            raise KeyboardInterrupt
        blocks.append(block)
        real(common, block)

    monkeypatch.setattr(chunked, "_fitted", stops)
    with pytest.raises(KeyboardInterrupt):
        fit_stored(Model(), source, target, 20)
    assert not target.exists()
    with pytest.raises(ValueError, match="belongs to another model"):
        fit_stored(Model(gain=ComplexGain(1.0)), source, target, 20)
    rest = []
    monkeypatch.setattr(chunked, "_fitted", lambda common, block: (rest.append(block), real(common, block)))
    fit_stored(Model(), source, target, 20)
    assert len(rest) == 3
    assert not set(map(str, rest)) & set(map(str, blocks))
    same(polinfer.load(target), polinfer.fit(Model(), measurement))
    # a record of progress that is no such thing
    part = target.with_name(".other.zarr.part")
    part.mkdir()
    part.with_suffix(".json").write_text(json.dumps([1]))
    with pytest.raises(ValueError, match="is damaged"):
        fit_stored(Model(), source, tmp_path / "other.zarr", 20)


def test_workers_fit_blocks_and_may_be_killed(tmp_path):
    distributed = pytest.importorskip("distributed", reason="dask is not installed (pip install 'polinfer[cluster]')")
    measurement = data((40, 30))
    source, target = save(measurement, tmp_path / "data.zarr"), tmp_path / "fit.zarr"
    killed, progress = [], tmp_path / ".fit.zarr.json"
    with workers(4) as cluster, distributed.Client(cluster) as client:
        client.wait_for_workers(4)

        def kill():
            while not (progress.exists() and len(json.loads(progress.read_text())["done"]) >= 2):
                time.sleep(0.01)
            killed.append(next(iter(client.run(os.getpid).values())))
            os.kill(killed[0], signal.SIGKILL)

        thread = threading.Thread(target=kill)
        thread.start()
        fit_stored(Model(), source, target, 30, client=client)
        thread.join()
    assert killed
    same(polinfer.load(target), polinfer.fit(Model(), measurement))


@pytest.mark.parametrize(
    ("change", "error", "text"),
    [
        ({"model": Model(misalignment=TiltPlane())}, ValueError, "TiltPlane"),
        ({"model": Model(noise=InferredNoise(2.0, 1e-3, "frame"))}, ValueError, "one sigma a frame"),
        ({"model": 3}, TypeError, "model must be Model"),
        ({"pixels": 0}, ValueError, "pixels must be >= 1"),
        ({"source": "absent.zarr"}, FileNotFoundError, "does not exist"),
        ({"source": "data.nc"}, ValueError, "must be a .zarr folder"),
        ({"source": "damaged.zarr"}, ValueError, "cannot be read"),
        ({"source": "fit-already.zarr"}, ValueError, "holds a Fit"),
        ({"source": "masked.zarr", "target": "m.zarr"}, ValueError, "mask has no True"),
        ({"target": "fit.nc"}, ValueError, "must be a .zarr folder"),
        ({"target": "fit-already.zarr"}, FileExistsError, "exists"),
    ],
)
def test_what_cannot_be_done_is_said(tmp_path, change, error, text):
    measurement = data((4, 5))
    save(measurement, tmp_path / "data.zarr")
    save(measurement, tmp_path / "data.nc")
    save(polinfer.fit(Model(), measurement), tmp_path / "fit-already.zarr")
    (tmp_path / "damaged.zarr").mkdir()
    save(replace(measurement, mask=np.ones((4, 5), bool)), tmp_path / "masked.zarr")
    zarr.open_group(tmp_path / "masked.zarr", mode="r+")["mask"][...] = False
    call = {"model": Model(), "source": "data.zarr", "target": "fit.zarr"} | change
    with pytest.raises(error, match=text):
        fit_stored(call.pop("model"), tmp_path / call.pop("source"), tmp_path / call.pop("target"), **call)


@pytest.mark.parametrize(
    ("call", "error", "text"),
    [
        (lambda path, m: Stored.create(path / "a.zarr", m, (4, 5, 1), (1, 1, 1)), ValueError, "must have the 2 axes"),
        (lambda path, m: Stored.create(path / "a.nc", m, (4, 5), (1, 1)), ValueError, "must be a .zarr folder"),
        (lambda path, m: Stored.create(path / "b.zarr", m, (4, 5), (1, 1)), FileExistsError, "exists"),
        (lambda path, m: Stored(path / "b.zarr").write((slice(0, 1), slice(0, 1)), m), ValueError, "the block"),
        (lambda path, m: Stored(path / "b.zarr").read((slice(0, 1),)), ValueError, "a slice for each of the 2"),
        (
            lambda path, m: Stored.create(path / "c.zarr", Measurement(np.eye(2), np.eye(2), 0.1), (), ()),
            ValueError,
            "no pixel axes",
        ),
    ],
)
def test_a_store_says_what_does_not_fit(tmp_path, call, error, text):
    measurement = data((4, 5))
    save(measurement, tmp_path / "b.zarr")
    with pytest.raises(error, match=text):
        call(tmp_path, measurement)


def test_a_model_travels_to_other_processes():
    model = Model(gain=ComplexGain(0.5), fixed={"diattenuation": 0.0}, neighbours=Window(3, 5))
    again = pickle.loads(pickle.dumps(model))  # noqa: S301
    assert again == model
    assert hash(again) == hash(model)
    with pytest.raises(TypeError, match="does not change"):
        again.fixed["diattenuation"] = 0.5
