"""The histogram of durations has an accuracy of 1 %, in memory of fixed size."""

import numpy as np
import pytest

from snakesim_hal.host.run_statistics import DurationHistogram


@pytest.mark.parametrize("percent", [1, 50, 99])
def test_histogram_percentiles_are_accurate_to_one_percent(percent: int) -> None:
    durations_us = np.random.default_rng(1).lognormal(6.0, 1.0, 20_000)
    histogram = DurationHistogram()
    for sample_us in durations_us.tolist():
        histogram.add(sample_us)
    assert histogram.count == 20_000
    assert histogram.percentile_us(percent) == pytest.approx(
        np.percentile(durations_us, percent), rel=0.01
    )


def test_histogram_value_out_of_range_counts_at_its_end() -> None:
    histogram = DurationHistogram()
    assert histogram.percentile_us(50) is None
    for duration_us in (-5.0, 0.0, 0.3):
        histogram.add(duration_us)
    assert histogram.percentile_us(99) == 1.0
    for _ in range(1000):
        histogram.add(1e12)
    assert histogram.percentile_us(99) == pytest.approx(1e7, rel=0.01)


def test_histogram_counts_each_value_from_shortest_to_longest() -> None:
    histogram = DurationHistogram(0.05)
    assert histogram.timing() is None
    for duration_us in [100.0] * 90 + [200.0] * 9 + [10_000.0]:
        histogram.add(duration_us)
    timing = histogram.timing()
    assert timing is not None
    assert timing.count == sum(timing.bins) == 100
    assert len(timing.bins) <= 16
    assert timing.median_us == pytest.approx(100, rel=0.05)
    assert timing.p99_us == pytest.approx(200, rel=0.05)
    assert timing.max_us == pytest.approx(10_000, rel=0.05)
    upper_ends_us = [
        timing.low_us * 10 ** (timing.bin_decades * (index + 1))
        for index in range(len(timing.bins))
    ]
    assert (
        next(
            sum(timing.bins[: index + 1])
            for index, upper_end_us in enumerate(upper_ends_us)
            if upper_end_us > 120
        )
        == 90
    )
    assert timing.bins[-1] == 1
