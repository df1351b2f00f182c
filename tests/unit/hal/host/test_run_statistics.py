"""Durations are counted to 1 %, in memory of fixed size."""

import numpy as np
import pytest

from snakesim_hal.host.run_statistics import DurationHistogram


@pytest.mark.parametrize("percent", [1, 50, 99])
def test_percentiles_are_right_to_one_percent(percent: int) -> None:
    took_us = np.random.default_rng(1).lognormal(6.0, 1.0, 20_000)
    durations = DurationHistogram()
    for one in took_us.tolist():
        durations.add(one)
    assert durations.count == 20_000
    assert durations.percentile_us(percent) == pytest.approx(
        np.percentile(took_us, percent), rel=0.01
    )


def test_what_is_out_of_range_counts_at_its_end() -> None:
    durations = DurationHistogram()
    assert durations.percentile_us(50) is None
    for one in (-5.0, 0.0, 0.3):
        durations.add(one)
    assert durations.percentile_us(99) == 1.0
    for _ in range(1000):
        durations.add(1e12)
    assert durations.percentile_us(99) == pytest.approx(1e7, rel=0.01)


def test_histogram_counts_each_value_from_shortest_to_longest() -> None:
    durations = DurationHistogram(0.05)
    assert durations.timing() is None
    for took_us in [100.0] * 90 + [200.0] * 9 + [10_000.0]:
        durations.add(took_us)
    timing = durations.timing()
    assert timing is not None
    assert timing.count == sum(timing.bins) == 100
    assert len(timing.bins) <= 16
    assert timing.median_us == pytest.approx(100, rel=0.05)
    assert timing.p99_us == pytest.approx(200, rel=0.05)
    assert timing.max_us == pytest.approx(10_000, rel=0.05)
    ends_us = [
        timing.low_us * 10 ** (timing.bin_decades * (place + 1))
        for place in range(len(timing.bins))
    ]
    assert (
        next(sum(timing.bins[: place + 1]) for place, end in enumerate(ends_us) if end > 120) == 90
    )
    assert timing.bins[-1] == 1
