"""A soak that sees nothing is worth nothing: what its watch must find, and that its dice repeat themselves."""

from itertools import islice

import pytest

from snakesim_hal.network.session import ConnectionSettings, open_session
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

ROBOT = make_description()  # 5 rad/s at 100 Hz, and 0.3 rad from the measured angle at most


def applied(tick: int, target: float) -> AppliedCommand:
    return AppliedCommand(
        tick=tick,
        timestamp_ns=0,
        sequence=tick,
        mode=[JointMode.POSITION] * 3,
        target=[target] * 3,
        torque_limit_nm=[1.0] * 3,
    )


def stopped(why: str, *causes: str) -> RobotStatus:
    return make_status(
        tick=1,
        lifecycle="fault",
        reason=why,
        faults=[Fault(tick=1, what="hot", cause=c) for c in causes],
    )


@pytest.mark.parametrize(
    ("targets", "measured", "found"),
    [
        ([0.0, 0.04], [0.0, 0.0], None),
        ([0.0, 0.2], [0.0, 0.0], "jumps 0.200 rad, at most 0.050"),
        ([0.0, 0.2], [0.0, 0.5], None),  # the measured angle has forced it
        ([0.35, 0.4], [0.0, 0.0], "0.400 rad away from where it is"),
    ],
)
def test_set_points_are_judged(
    targets: list[float], measured: list[float], found: str | None
) -> None:
    endpoint = find_free_endpoint()
    with (
        open_session(ConnectionSettings(endpoint, "worm", listen=True)) as hal,
        open_session(ConnectionSettings(endpoint, "worm")) as session,
    ):
        hal.declare_latched_publisher(keys.DESCRIPTION, RobotDescription).put(ROBOT)
        watch = JudgingObserver(session)
        watch.joints = {
            tick: make_joint_state(ROBOT, angle, tick=tick) for tick, angle in enumerate(measured)
        }
        for tick, target in enumerate(targets):
            watch.judge(applied(tick, target))
        assert (
            any(found in violation for violation in watch.violations)
            if found
            else watch.violations == []
        )


def test_a_fault_that_is_not_explained_is_found() -> None:
    endpoint = find_free_endpoint()
    with (
        open_session(ConnectionSettings(endpoint, "worm", listen=True)) as hal,
        open_session(ConnectionSettings(endpoint, "worm")) as session,
    ):
        watch, teller = (
            JudgingObserver(session),
            hal.declare_latched_publisher(keys.STATUS, RobotStatus),
        )
        for reported in (stopped("too hot", "too hot"), stopped("too hot"), stopped("", "too hot")):
            watch.status = None
            teller.put(reported)
            wait_until(lambda: watch.listen() or watch.status is not None, "the status")
        assert watch.violations[0] == "fault without a fault: too hot"
        assert "fault without a why" in watch.violations


def test_one_seed_draws_the_same_faults() -> None:
    drawn = [
        [str(event) for event in islice(EventDrawer(seed, 13).events(), 200)] for seed in (1, 1, 2)
    ]
    assert drawn[0] == drawn[1] != drawn[2]
    kinds = {text.split()[1].partition(":")[0] for text in drawn[0]}
    assert {"kill", "freeze", "drop", "corrupt", "mute", "slow"} <= kinds
