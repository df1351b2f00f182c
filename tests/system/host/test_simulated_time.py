"""Simulated time can be paused, stepped by single ticks, and run at another speed, on a real host with a controller."""

import time
from typing import Any

import pytest

from snakesim_hal.host.simulated_time import SimulatedTime, SimulatorRefusal
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import ClockMode, EstopRequest, SimulatorRequest
from snakesim_testing.hal.local_network import RunningHost, running_commanded_host
from snakesim_testing.hal.small_robots import make_description, make_run_config
from snakesim_testing.harness.wait import wait_until

LONG_LEASE: dict[str, Any] = {"rate_hz": 50.0}  # At this rate a lease has its maximum, 100 ms.
MANY_LEASES_S = 0.5
SIMULATED_SPEED = 0.2  # of real time

pytestmark = pytest.mark.usefixtures("quick_threads")


def request_action(run: RunningHost, action: Any, **options: Any) -> str:
    """Request an action of the simulator, and return the reason in the answer."""
    request = SimulatorRequest(action=action, requester="ada", **options)
    answer = run.request(keys.SIMULATOR, request)
    assert answer.ok, answer.reason
    return answer.reason


def wait_for_pause(run: RunningHost) -> int:
    """Wait until the host reports the pause, and return the tick at which it paused."""
    wait_until(lambda: run.status.paused_by == "ada", "the pause in the status")
    return run.backend.advanced


@pytest.mark.parametrize(
    "clock_mode", [pytest.param("realtime", marks=pytest.mark.quiet), "lockstep"]
)
def test_pause_lets_no_lease_expire_and_steps_are_exact(clock_mode: ClockMode) -> None:
    with running_commanded_host(make_run_config(clock_mode=clock_mode, **LONG_LEASE)) as (
        run,
        control,
    ):
        assert "paused by ada" in request_action(run, "pause")
        tick = wait_for_pause(run)
        time.sleep(MANY_LEASES_S)
        assert run.backend.advanced == tick
        assert run.status.lifecycle == "armed"
        for ticks in (1, 4):
            request_action(run, "step", ticks=ticks)
            tick += ticks
            wait_until(lambda: run.backend.advanced >= tick, f"{ticks} ticks")  # noqa: B023
            assert wait_for_pause(run) == tick
        request_action(run, "resume")
        wait_until(lambda: run.backend.advanced > tick + 5, "ticks after the pause")
        assert run.host.authority.state == "armed", run.host.authority.faults
        assert not run.host.authority.faults
        assert control.ticks_seen == sorted(control.ticks_seen)
        assert "step by 'ada', done" in run.host.request_log[-2]


def test_pause_with_silent_controller_stops_robot_after_resume() -> None:
    """The lease counts robot time, so that a pause neither shortens nor extends it."""
    with running_commanded_host(make_run_config(clock_mode="realtime", **LONG_LEASE)) as (
        run,
        control,
    ):
        request_action(run, "pause")
        wait_for_pause(run)
        control.silent.set()
        request_action(run, "resume")
        run.wait_for_lifecycle("fault")
        assert {fault.what for fault in run.host.authority.faults} == {"lease_expired"}


def test_pause_emergency_stop_is_immediate_and_remains_after_resume() -> None:
    with running_commanded_host(make_run_config(clock_mode="realtime", **LONG_LEASE)) as (run, _):
        request_action(run, "pause")
        tick = wait_for_pause(run)
        assert run.request(keys.ESTOP, EstopRequest(requester="bob")).lifecycle == "estop"
        run.wait_for_lifecycle("estop")
        assert run.backend.advanced == tick
        request_action(run, "resume")
        wait_until(lambda: run.backend.advanced > tick + 3, "ticks")
        assert run.status.lifecycle == "estop"
        assert not run.request_lifecycle("arm").ok


@pytest.mark.quiet
def test_simulated_speed_scales_real_time_and_reset_ends_disarmed() -> None:
    with running_commanded_host(make_run_config(clock_mode="realtime", **LONG_LEASE)) as (run, _):
        request_action(run, "speed", speed=SIMULATED_SPEED)
        wait_until(lambda: run.status.real_time_factor is not None, "a measured speed")
        assert run.status.speed == SIMULATED_SPEED
        assert run.status.real_time_factor == pytest.approx(SIMULATED_SPEED, rel=0.3)
        assert run.status.lifecycle == "armed", run.status.reason
        request_action(run, "reset")
        wait_until(run.has_ended, "the host's end")
        assert run.host.ending_status == "reset"
        assert run.host.authority.state == "disarmed"


@pytest.mark.parametrize(
    ("simulated", "clock_mode", "request_fields", "expected_code"),
    [
        (False, "realtime", {"action": "pause"}, "not_simulated"),
        (False, "realtime", {"action": "reset"}, "not_simulated"),
        (True, "lockstep", {"action": "speed", "speed": 2.0}, "wrong_clock_mode"),
        (True, "lockstep", {"action": "resume"}, "wrong_state"),
    ],
)
def test_simulated_time_impossible_request_is_refused_with_code(
    simulated: bool, clock_mode: ClockMode, request_fields: dict[str, Any], expected_code: str
) -> None:
    simulated_time = SimulatedTime(
        make_description(simulated_time=simulated), clock_mode, lambda: 0
    )
    outcome = simulated_time.execute_request(SimulatorRequest(**request_fields), 0)
    assert isinstance(outcome, SimulatorRefusal)
    assert outcome.code == expected_code
    assert not simulated_time.is_paused


def test_safety_time_at_changes_of_speed_is_continuous() -> None:
    """Safety time is continuous at every pause, step and change of speed.

    So is the safety time of a sample that arrived before the change.
    """
    wall_ns = [1000]
    simulated_time = SimulatedTime(
        make_description(simulated_time=True), "realtime", lambda: wall_ns[0]
    )
    tick = 0
    safety_times_ns = [simulated_time.safety_ns(0)]
    period_ns = make_description().period_ns
    for action, options in (
        ("pause", {}),
        ("step", {"ticks": 2}),
        ("resume", {}),
        ("speed", {"speed": 5.0}),
        ("pause", {}),
        ("resume", {}),
        ("speed", {"speed": 1.0}),
    ):
        before_ns = simulated_time.safety_ns(tick)
        simulated_time.execute_request(SimulatorRequest(action=action, **options), tick)  # pyright: ignore[reportArgumentType]
        assert simulated_time.safety_ns(tick) == before_ns
        assert simulated_time.safety_ns(tick, wall_ns[0] - 500) >= before_ns - 500
        for _ in range(3):
            if not simulated_time.is_paused:
                tick += 1
            wall_ns[0] += period_ns
            simulated_time.on_tick_end(tick)
            safety_times_ns.append(simulated_time.safety_ns(tick))
    assert safety_times_ns == sorted(safety_times_ns)
    assert safety_times_ns[-1] - safety_times_ns[0] <= wall_ns[0]
