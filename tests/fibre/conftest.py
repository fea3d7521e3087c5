"""What several files of tests share: made once a process."""

import pytest

from tests.fibre.scenes import scene


@pytest.fixture(scope="session")
def standard():
    """The synthetic scene of 109 fibrelets and 64 points."""
    return scene()
