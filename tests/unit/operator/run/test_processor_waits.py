"""Who waited for a processor for so long that a lease could expire."""

import os
import threading
from collections.abc import Iterable

import pytest

from snakesim_operator.run.processes.processor_waits import ProcessorWaits, ThreadUsage, read_usages

HOST, CONTROL, RECEIVER = 1, 2, 3  # the last is a thread of control
PIDS = {"host": HOST, "control": CONTROL}
IDLE = ThreadUsage(0.0, 0.0, False)


def waits_of(rows: Iterable[tuple[float, ThreadUsage]]) -> ProcessorWaits:
    """rows: time, and what the kernel tells of a thread of control then."""
    now, told = [0.0], {HOST: {HOST: IDLE}, CONTROL: {CONTROL: IDLE, RECEIVER: IDLE}}
    made = ProcessorWaits(0.1, read=lambda pid: told[pid], clock=lambda: now[0])
    for now[0], told[CONTROL][RECEIVER] in rows:
        made.take_sample(PIDS)
    return made


def waits(*rows: tuple[float, float]) -> list[tuple[float, ThreadUsage]]:
    """Time, and how long it has waited until then; it runs a little all the time."""
    return [(at_s, ThreadUsage(0.01 * at_s, waited_s, True)) for at_s, waited_s in rows]


def test_processor_wait_of_most_of_a_lease_is_named() -> None:
    found = waits_of(waits((0.0, 5.0), (0.1, 5.09), (0.2, 5.09))).find_longest()
    assert found is not None
    assert found[0] == "control"
    assert found[1:] == pytest.approx((0.09, 0.1))


def test_processor_wait_in_progress_counts_before_kernel_reports_it() -> None:
    found = waits_of((0.1 * i, ThreadUsage(1.0, 2.0, True)) for i in range(4)).find_longest()
    assert found is not None
    assert found[0] == "control"
    assert found[1] == pytest.approx(found[2])


def test_who_sleeps_or_is_stopped_does_not_wait() -> None:
    assert (
        waits_of((0.1 * i, ThreadUsage(1.0, 2.0, False)) for i in range(20)).find_longest() is None
    )


def test_short_waits_at_any_time_are_nothing() -> None:
    assert waits_of(waits(*((0.1 * i, 0.02 * i) for i in range(40)))).find_longest() is None


def test_processor_wait_long_ago_is_no_cause() -> None:
    rows = waits(*((0.1 * i, min(0.1 * i, 0.5)) for i in range(60)))
    assert waits_of(rows[:10]).find_longest() is not None
    assert waits_of(rows).find_longest() is None


def test_processor_waits_are_found_by_rare_sampling() -> None:
    """On a slow computer whoever looks is late, too."""
    assert waits_of(waits((0.0, 0.0), (3.0, 2.9))).find_longest() == pytest.approx(
        ("control", 2.9, 3.0)
    )


def test_where_the_kernel_does_not_tell_nothing_is_said() -> None:
    silent = ProcessorWaits(0.1, read=lambda _pid: {})
    for _ in range(3):
        silent.take_sample(PIDS)
    assert silent.find_longest() is None
    assert read_usages(-1) == {}


def test_processor_waits_come_from_the_kernel() -> None:
    ours = read_usages(os.getpid())[threading.get_native_id()]
    assert ours.ran_s > 0
    assert ours.ready
