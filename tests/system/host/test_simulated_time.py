"""A simulator's time: it stands, passes by single ticks or at another speed. A real host, and a client that follows."""

import time
from typing import Any

import pytest

from snakesim_hal.host.simulated_time import SimulatedTime, SimulatorRefusal
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import ClockMode, EstopRequest, SimulatorRequest
from snakesim_testing.hal.local_network import RunningHost, running_commanded_host
from snakesim_testing.hal.small_robots import make_description, make_run_config
from snakesim_testing.harness.wait import wait_until

PATIENT: dict[str, Any] = {"rate_hz": 50.0}  # with the longest lease, 100 ms
MANY_LEASES_S = 0.5


pytestmark = pytest.mark.usefixtures("quick_threads")


def ask(run: RunningHost, action: Any, **more: Any) -> str:
    answer = run.request(keys.SIMULATOR, SimulatorRequest(action=action, requester="ada", **more))
    assert answer.ok, answer.reason
    return answer.reason


def stands_at(run: RunningHost) -> int:
    wait_until(lambda: run.status.paused_by == "ada", "the pause in the status")
    return run.backend.advanced


@pytest.mark.parametrize("clock_mode", ["realtime", "lockstep"])
def test_nothing_expires_in_a_pause_and_steps_are_exact(clock_mode: ClockMode) -> None:
    with running_commanded_host(make_run_config(clock_mode=clock_mode, **PATIENT)) as (
        run,
        control,
    ):
        assert "paused by ada" in ask(run, "pause")
        tick = stands_at(run)
        time.sleep(MANY_LEASES_S)
        assert run.backend.advanced == tick
        assert run.status.lifecycle == "armed"
        for ticks in (1, 4):
            ask(run, "step", ticks=ticks)
            tick += ticks
            wait_until(lambda: run.backend.advanced >= tick, f"{ticks} ticks")  # noqa: B023
            assert stands_at(run) == tick
        ask(run, "resume")
        wait_until(lambda: run.backend.advanced > tick + 5, "ticks after the pause")
        assert run.host.authority.state == "armed" and not run.host.authority.faults, (
            run.host.authority.faults
        )
        assert control.ticks_seen == sorted(control.ticks_seen)
        assert "step by 'ada', done" in run.host.request_log[-2]


def test_pause_controller_death_stops_the_robot_afterwards() -> None:
    """The lease counts robot time: it is as long after a pause as it was before."""
    with running_commanded_host(make_run_config(clock_mode="realtime", **PATIENT)) as (
        run,
        control,
    ):
        ask(run, "pause")
        stands_at(run)
        control.silent.set()
        ask(run, "resume")
        run.wait_for_lifecycle("fault")
        assert {fault.what for fault in run.host.authority.faults} == {"lease_expired"}


def test_pause_emergency_stop_is_immediate_and_outlasts_it() -> None:
    with running_commanded_host(make_run_config(clock_mode="realtime", **PATIENT)) as (run, _):
        ask(run, "pause")
        tick = stands_at(run)
        assert run.request(keys.ESTOP, EstopRequest(requester="bob")).lifecycle == "estop"
        run.wait_for_lifecycle("estop")
        assert run.backend.advanced == tick
        ask(run, "resume")
        wait_until(lambda: run.backend.advanced > tick + 3, "ticks")
        assert run.status.lifecycle == "estop"
        assert not run.request_lifecycle("arm").ok


def test_simulated_speed_scales_real_time_and_reset_ends_disarmed() -> None:
    with running_commanded_host(make_run_config(clock_mode="realtime", **PATIENT)) as (run, _):
        ask(run, "speed", speed=0.2)
        wait_until(lambda: run.status.real_time_factor is not None, "a measured speed")
        assert run.status.speed == 0.2
        assert run.status.real_time_factor == pytest.approx(0.2, rel=0.3)
        assert run.status.lifecycle == "armed", run.status.reason
        ask(run, "reset")
        wait_until(run.has_ended, "the host's end")
        assert run.host.ending_status == "reset"
        assert run.host.authority.state == "disarmed"


@pytest.mark.parametrize(
    ("simulated", "clock_mode", "asked", "word"),
    [
        (False, "realtime", {"action": "pause"}, "not_simulated"),
        (False, "realtime", {"action": "reset"}, "not_simulated"),
        (True, "lockstep", {"action": "speed", "speed": 2.0}, "wrong_clock_mode"),
        (True, "lockstep", {"action": "resume"}, "wrong_state"),
    ],
)
def test_what_cannot_be_is_refused_in_words(
    simulated: bool, clock_mode: ClockMode, asked: dict[str, Any], word: str
) -> None:
    made = SimulatedTime(make_description(simulated_time=simulated), clock_mode, lambda: 0)
    outcome = made.execute_request(SimulatorRequest(**asked), 0)
    assert isinstance(outcome, SimulatorRefusal)
    assert outcome.code == word
    assert not made.is_paused


def test_safety_time_neither_jumps_nor_goes_back() -> None:
    """At any change of speed; a sample that arrived before a change is not from before it."""
    wall = [1000]
    made = SimulatedTime(make_description(simulated_time=True), "realtime", lambda: wall[0])
    tick, seen, period_ns = 0, [made.safety_ns(0)], make_description().period_ns
    for action, more in (
        ("pause", {}),
        ("step", {"ticks": 2}),
        ("resume", {}),
        ("speed", {"speed": 5.0}),
        ("pause", {}),
        ("resume", {}),
        ("speed", {"speed": 1.0}),
    ):
        before = made.safety_ns(tick)
        made.execute_request(SimulatorRequest(action=action, **more), tick)  # pyright: ignore[reportArgumentType]
        assert made.safety_ns(tick) == before
        assert made.safety_ns(tick, wall[0] - 500) >= before - 500
        for _ in range(3):
            if not made.is_paused:
                tick += 1
            wall[0] += period_ns
            made.on_tick_end(tick)
            seen.append(made.safety_ns(tick))
    assert seen == sorted(seen)
    assert seen[-1] - seen[0] <= wall[0]
