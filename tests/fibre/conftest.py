"""What several files of tests share: made once a process."""

import pytest

from tests.fibre.benches import small
from tests.fibre.scenes import scene


@pytest.fixture(scope="session")
def standard():
    """The synthetic scene of 109 fibrelets and 64 points."""
    return scene()


@pytest.fixture(scope="session")
def bench(tmp_path_factory):
    """The small simulated bench, captured and retrieved."""
    return small(tmp_path_factory.mktemp("bench"))
