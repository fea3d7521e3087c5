"""Rows spread over dask workers are the rows of one process, whatever happens to the workers."""

import os
import signal
import threading
import time
from dataclasses import dataclass

import numpy as np
import pytest

from fibre import ForwardInverse, Ridge, recover
from fibre.recovery import base
from tests.clusters import workers

distributed = pytest.importorskip("distributed", reason="dask is not installed (pip install 'polinfer[cluster]')")


@dataclass(frozen=True)
class Slow(Ridge):
    """Long enough for a worker to be killed in the middle."""

    def rows(self, prepared, points, chosen):
        time.sleep(0.05)
        return super().rows(prepared, points, chosen)


@dataclass(frozen=True)
class Broken(Ridge):
    def rows(self, prepared, points, chosen):
        raise ArithmeticError("a point that cannot be solved")


@pytest.fixture(scope="module")
def cluster():
    with workers(4) as made:
        yield made


@pytest.fixture
def client(cluster, monkeypatch):
    monkeypatch.setattr(base, "PART", 8)
    with distributed.Client(cluster) as made:
        made.wait_for_workers(4)
        yield made


def same(one, other):
    assert np.abs((one.matrix - other.matrix).toarray()).max() <= 1e-6 * np.abs(one.matrix.toarray()).max()


def test_workers_find_the_rows_of_one_process(standard, client):
    fields = standard.calibration(0.01, 1)
    same(recover(fields, ForwardInverse()), recover(fields, ForwardInverse(), client=client))


def test_a_killed_worker_and_an_interruption_cost_nothing(standard, client, tmp_path):
    fields, folder = standard.calibration(0.01, 1), tmp_path / "rows"
    killed = []

    def kill():
        while len(list(folder.glob("rows_*.nc"))) < 2:
            time.sleep(0.02)
        killed.append(next(iter(client.run(os.getpid).values())))
        os.kill(killed[0], signal.SIGKILL)

    thread = threading.Thread(target=kill)
    thread.start()
    found = recover(fields, Slow(), folder=folder, client=client)
    thread.join()
    assert killed
    assert killed[0] not in client.run(os.getpid).values()
    same(recover(fields, Ridge()), found)
    # what is in the folder is not computed again, with workers or without
    parts = sorted(folder.glob("rows_*.nc"))
    assert len(parts) == 8
    parts[3].unlink()
    before = {p: p.stat().st_mtime_ns for p in folder.glob("rows_*.nc")}
    same(found, recover(fields, Slow(), folder=folder))
    assert {p: p.stat().st_mtime_ns for p in before} == before
    assert parts[3].exists()


def test_errors_of_the_rows_come_back_as_they_are(standard, client):
    with pytest.raises(ArithmeticError, match="cannot be solved"):
        recover(standard.calibration(0.01, 1), Broken(), client=client)


def test_other_clients_are_refused(standard):
    with pytest.raises(TypeError, match="client must be a dask"):
        recover(standard.calibration(0.01, 1), Ridge(), client="localhost")
