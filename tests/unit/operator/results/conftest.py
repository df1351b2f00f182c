"""One run for all tests of results."""

import pytest

from snakesim_operator.results.run_log import RunRecord
from tests.unit.operator.results.triplet_run import triplet


@pytest.fixture(scope="session")
def record() -> RunRecord:
    return triplet()
