"""Latencies are counted to 1 %, in memory of fixed size."""

import numpy as np
import pytest

from snakesim_hal.host.run_statistics import BINS, Latencies


@pytest.mark.parametrize("percent", [1, 50, 99])
def test_percentiles_are_right_to_one_percent(percent: int) -> None:
    took_us = np.random.default_rng(1).lognormal(6.0, 1.0, 20_000)
    latencies = Latencies()
    for one in took_us.tolist():
        latencies.add(one)
    assert latencies.count == 20_000
    assert latencies.percentile_us(percent) == pytest.approx(np.percentile(took_us, percent), rel=0.01)


def test_what_is_out_of_range_counts_at_its_end() -> None:
    latencies = Latencies()
    assert latencies.percentile_us(50) is None
    for one in (-5.0, 0.0, 0.3):
        latencies.add(one)
    assert latencies.percentile_us(99) == 1.0
    for _ in range(1000):
        latencies.add(1e12)
    assert latencies.percentile_us(99) == pytest.approx(1e7, rel=0.01) and len(latencies._bins) == BINS
