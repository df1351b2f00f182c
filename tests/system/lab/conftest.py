"""One lab for all tests here."""

from collections.abc import Iterator

import pytest

from snakesim_testing.lab.small_lab import RunningLab, running_test_lab


@pytest.fixture(scope="package")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningLab]:
    with running_test_lab(tmp_path_factory.mktemp("lab")) as running:
        yield running
