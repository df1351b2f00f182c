"""Provides one simulated run for all tests of results."""

import pytest

from snakesim_operator.results.run_log import RunRecord
from snakesim_testing.operator.triplet_report import simulate_triplet


@pytest.fixture(scope="session")
def record() -> RunRecord:
    """The record of a run of the scenario `triplet`, which is simulated only once."""
    return simulate_triplet()
