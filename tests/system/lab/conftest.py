"""Provides one running lab for all tests of this folder."""

from collections.abc import Iterator

import pytest

from snakesim_testing.lab.small_lab import RunningLab, running_test_lab


@pytest.fixture(scope="package")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningLab]:
    """Start a lab with two robots on loopback, and stop it after the last test."""
    with running_test_lab(tmp_path_factory.mktemp("lab")) as running:
        yield running
