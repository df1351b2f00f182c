"""The watch of a soak finds jumps and unexplained faults, and one seed draws the same faults again."""

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice

import pytest

from snakesim_hal.network.session import ConnectionSettings, Session, open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import (
    AppliedCommand,
    Fault,
    JointMode,
    RobotDescription,
    RobotStatus,
)
from snakesim_testing.hal.small_robots import make_description, make_joint_state, make_status
from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.harness.wait import wait_until
from verification.soak.faults import EventDrawer
from verification.soak.watch import JudgingObserver

# Limits of its joints: 5 rad/s at 100 Hz, and 0.3 rad from the measured angle.
ROBOT = make_description()
NAMESPACE = "worm"


@contextmanager
def open_host_and_observer() -> Iterator[tuple[Session, JudgingObserver]]:
    endpoint = find_free_endpoint()
    with (
        open_session(ConnectionSettings(endpoint, NAMESPACE, listen=True)) as host,
        open_session(ConnectionSettings(endpoint, NAMESPACE)) as session,
    ):
        yield host, JudgingObserver(session)


def make_applied_command(tick: int, target_rad: float) -> AppliedCommand:
    return AppliedCommand(
        tick=tick,
        timestamp_ns=0,
        sequence=tick,
        mode=[JointMode.POSITION] * 3,
        target=[target_rad] * 3,
        torque_limit_nm=[1.0] * 3,
    )


def make_fault_status(reason: str, *causes: str) -> RobotStatus:
    faults = [Fault(tick=1, what="hot", cause=cause) for cause in causes]
    return make_status(tick=1, lifecycle="fault", reason=reason, faults=faults)


@pytest.mark.parametrize(
    ("targets_rad", "measured_rad", "expected_violation"),
    [
        ([0.0, 0.04], [0.0, 0.0], None),
        ([0.0, 0.2], [0.0, 0.0], "jumps 0.200 rad, at most 0.050"),
        ([0.0, 0.2], [0.0, 0.5], None),  # the measured angle has forced it
        ([0.35, 0.4], [0.0, 0.0], "is 0.400 rad from the measured angle"),
    ],
)
def test_watch_finds_setpoints_that_jump_or_are_far(
    targets_rad: list[float], measured_rad: list[float], expected_violation: str | None
) -> None:
    with open_host_and_observer() as (host, watch):
        host.declare_latched_publisher(keys.DESCRIPTION, RobotDescription).put(ROBOT)
        watch.joints = {
            tick: make_joint_state(ROBOT, angle_rad, tick=tick)
            for tick, angle_rad in enumerate(measured_rad)
        }
        for tick, target_rad in enumerate(targets_rad):
            watch.judge_command(make_applied_command(tick, target_rad))
        if expected_violation is None:
            assert watch.violations == []
        else:
            assert any(expected_violation in violation for violation in watch.violations)


def test_watch_finds_faults_without_explanation() -> None:
    with open_host_and_observer() as (host, watch):
        publisher = host.declare_latched_publisher(keys.STATUS, RobotStatus)
        for status in (
            make_fault_status("too hot", "too hot"),
            make_fault_status("too hot"),
            make_fault_status("", "too hot"),
        ):
            watch.status = None
            publisher.put(status)
            wait_until(lambda: watch.listen() or watch.status is not None, "the status")
        assert watch.violations[0] == "fault without a fault: too hot"
        assert "fault without a reason" in watch.violations


def test_event_drawer_repeats_events_of_one_seed() -> None:
    events_by_run = [
        [str(event) for event in islice(EventDrawer(seed, 13).draw_events(), 200)]
        for seed in (1, 1, 2)
    ]
    assert events_by_run[0] == events_by_run[1] != events_by_run[2]
    kinds = {event.split()[1].partition(":")[0] for event in events_by_run[0]}
    assert {"kill", "freeze", "drop", "corrupt", "mute", "slow"} <= kinds
