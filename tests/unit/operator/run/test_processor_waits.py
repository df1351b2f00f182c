"""Which process waited for a processor for so long that a lease could expire."""

import os
import threading
from collections.abc import Iterable

import pytest

from snakesim_operator.run.processes.processor_waits import ProcessorWaits, ThreadUsage, read_usages

HOST = 1
CONTROL = 2
RECEIVER = 3  # a thread of the control process
LEASE_S = 0.1
PIDS = {"host": HOST, "control": CONTROL}
IDLE = ThreadUsage(0.0, 0.0, False)


def sample_receiver(samples: Iterable[tuple[float, ThreadUsage]]) -> ProcessorWaits:
    """Take samples at these times in s, in which the receiver thread of control has these usages."""
    now_s = 0.0
    usages = {HOST: {HOST: IDLE}, CONTROL: {CONTROL: IDLE, RECEIVER: IDLE}}
    processor_waits = ProcessorWaits(LEASE_S, read=lambda pid: usages[pid], clock=lambda: now_s)
    for sample_time_s, usage in samples:
        now_s = sample_time_s
        usages[CONTROL][RECEIVER] = usage
        processor_waits.take_sample(PIDS)
    return processor_waits


def make_usages(*waits: tuple[float, float]) -> list[tuple[float, ThreadUsage]]:
    """Make samples of a thread that runs 1 % of the time.

    Args:
        waits: time, and how long the thread has waited until then, both in s.
    """
    return [(time_s, ThreadUsage(0.01 * time_s, waited_s, True)) for time_s, waited_s in waits]


def test_processor_wait_of_most_of_a_lease_is_named() -> None:
    usages = make_usages((0.0, 5.0), (0.1, 5.09), (0.2, 5.09))
    longest = sample_receiver(usages).find_longest()
    assert longest is not None
    assert longest[0] == "control"
    assert longest[1:] == pytest.approx((0.09, 0.1))


def test_processor_wait_in_progress_counts_before_kernel_reports_it() -> None:
    ready = ThreadUsage(1.0, 2.0, True)
    longest = sample_receiver((0.1 * i, ready) for i in range(4)).find_longest()
    assert longest is not None
    process, waited_s, period_s = longest
    assert process == "control"
    assert waited_s == pytest.approx(period_s)


def test_processor_wait_of_sleeping_or_stopped_thread_is_none() -> None:
    sleeping = ThreadUsage(1.0, 2.0, False)
    assert sample_receiver((0.1 * i, sleeping) for i in range(20)).find_longest() is None


def test_processor_waits_that_are_short_are_no_cause() -> None:
    usages = make_usages(*((0.1 * i, 0.02 * i) for i in range(40)))
    assert sample_receiver(usages).find_longest() is None


def test_processor_wait_long_ago_is_no_cause() -> None:
    usages = make_usages(*((0.1 * i, min(0.1 * i, 0.5)) for i in range(60)))
    assert sample_receiver(usages[:10]).find_longest() is not None
    assert sample_receiver(usages).find_longest() is None


def test_processor_waits_are_found_by_rare_sampling() -> None:
    """On a slow computer the process that takes the samples is late, too."""
    longest = sample_receiver(make_usages((0.0, 0.0), (3.0, 2.9))).find_longest()
    assert longest == pytest.approx(("control", 2.9, 3.0))


def test_processor_waits_without_kernel_figures_are_none() -> None:
    processor_waits = ProcessorWaits(LEASE_S, read=lambda _pid: {})
    for _ in range(3):
        processor_waits.take_sample(PIDS)
    assert processor_waits.find_longest() is None
    assert read_usages(-1) == {}


def test_processor_waits_come_from_the_kernel() -> None:
    own_usage = read_usages(os.getpid())[threading.get_native_id()]
    assert own_usage.ran_s > 0
    assert own_usage.ready
