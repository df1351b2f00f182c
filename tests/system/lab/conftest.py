"""One lab for all tests here."""

from collections.abc import Iterator

import pytest

from snakesim_testing.lab.small_lab import SmallLab, small_lab


@pytest.fixture(scope="package")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SmallLab]:
    with small_lab(tmp_path_factory.mktemp("lab")) as running:
        yield running
