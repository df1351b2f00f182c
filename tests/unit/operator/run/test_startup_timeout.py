"""How long a run waits for a robot to become ready: in robot time, so that a slow computer does not shorten it."""

from collections.abc import Sequence

from snakesim_hal.wire.messages import RobotStatus
from snakesim_operator.run.arming_timeout import StartupTimeout
from snakesim_testing.hal import small_robots as rig

TIMEOUT_S = 60.0
ALL_SERVICES = ("guidance", "control")


def make_startup_status(
    tick: int = 0,
    *,
    alive: Sequence[str] = ALL_SERVICES,
    ready: bool = False,
    waiting_for: Sequence[str] = ("guidance",),
) -> RobotStatus:
    """Make the status of a robot that starts, in this tick of robot time."""
    return rig.make_status(
        tick=tick,
        timestamp_ns=tick * rig.PERIOD_NS,
        ready_to_arm=ready,
        alive=alive,
        waiting_for=waiting_for,
    )


def test_startup_timeout_counts_robot_time_on_slow_computer() -> None:
    timeout = StartupTimeout(ALL_SERVICES, TIMEOUT_S)
    assert not any(
        timeout.update_and_check_expired(make_startup_status(tick), now_s=100.0 * tick)
        for tick in range(1, 6001, 100)
    )
    assert timeout.update_and_check_expired(make_startup_status(6102), now_s=0.0)


def test_startup_timeout_in_paused_time_counts_host_answers() -> None:
    timeout = StartupTimeout(ALL_SERVICES, TIMEOUT_S)
    assert not any(
        timeout.update_and_check_expired(make_startup_status(), now_s=3600.0 * hour)
        for hour in range(60)
    )
    repeated_status = make_startup_status()
    assert not any(
        timeout.update_and_check_expired(repeated_status, now_s=3600.0 * hour)
        for hour in range(60, 160)
    )
    assert not timeout.update_and_check_expired(None, now_s=1e6)
    assert any(
        timeout.update_and_check_expired(make_startup_status(), now_s=1e6 + 0.5 * answer)
        for answer in range(10)
    )


def test_startup_timeout_restarts_with_every_progress() -> None:
    timeout = StartupTimeout(ALL_SERVICES, TIMEOUT_S)
    statuses = [
        make_startup_status(0),
        make_startup_status(5000),
        make_startup_status(9000, waiting_for=["control"]),
        make_startup_status(14000, waiting_for=["control"]),
        make_startup_status(19000, waiting_for=["control"], ready=True),
        make_startup_status(24000, waiting_for=["control"], alive=["control"]),
        make_startup_status(50000, waiting_for=["control"], alive=["control"]),
        make_startup_status(55000, waiting_for=["control"]),
        make_startup_status(60000, waiting_for=["control"]),
    ]
    assert not any(timeout.update_and_check_expired(status, now_s=0.0) for status in statuses)
    assert timeout.update_and_check_expired(
        make_startup_status(62000, waiting_for=["control"]), now_s=0.0
    )
