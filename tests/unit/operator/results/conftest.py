"""One run for all tests of results."""

import pytest

from snakesim_operator.results.run_log import RunRecord
from snakesim_testing.operator.recorded_triplet import triplet


@pytest.fixture(scope="session")
def record() -> RunRecord:
    return triplet()
