"""How long a run waits for a robot that is on: in robot time where it passes, and never for a slow computer."""

from collections.abc import Sequence

from snakesim_hal.wire.messages import RobotStatus
from snakesim_operator.run.arming_timeout import StartupTimeout
from snakesim_testing.hal import small_robots as rig

ALL = ("guidance", "control")


def status(
    tick: int = 0,
    *,
    alive: Sequence[str] = ALL,
    ready: bool = False,
    waiting_for: Sequence[str] = ("guidance",),
) -> RobotStatus:
    return rig.make_status(
        tick=tick,
        timestamp_ns=tick * rig.PERIOD_NS,
        ready_to_arm=ready,
        alive=alive,
        waiting_for=waiting_for,
    )


def test_patience_counts_robot_time_on_a_slow_computer() -> None:
    patience = StartupTimeout(ALL, 60.0)
    assert not any(
        patience.update_and_check_expired(status(tick), now_s=100.0 * tick)
        for tick in range(1, 6001, 100)
    )
    assert patience.update_and_check_expired(status(6102), now_s=0.0)


def test_patience_in_paused_time_counts_only_while_host_answers() -> None:
    patience = StartupTimeout(ALL, 60.0)
    assert not any(
        patience.update_and_check_expired(status(), now_s=3600.0 * hour) for hour in range(60)
    )
    same = status()
    assert not any(
        patience.update_and_check_expired(same, now_s=3600.0 * hour) for hour in range(60, 160)
    )
    assert not patience.update_and_check_expired(None, now_s=1e6)
    assert any(
        patience.update_and_check_expired(status(), now_s=1e6 + 0.5 * half) for half in range(10)
    )


def test_patience_restarts_with_every_progress() -> None:
    patience = StartupTimeout(ALL, 60.0)
    steps = [
        status(0),
        status(5000),
        status(9000, waiting_for=["control"]),
        status(14000, waiting_for=["control"]),
        status(19000, waiting_for=["control"], ready=True),
        status(24000, waiting_for=["control"], alive=["control"]),
        status(50000, waiting_for=["control"], alive=["control"]),
        status(55000, waiting_for=["control"]),
        status(60000, waiting_for=["control"]),
    ]
    assert not any(patience.update_and_check_expired(step, now_s=0.0) for step in steps)
    assert patience.update_and_check_expired(status(62000, waiting_for=["control"]), now_s=0.0)
