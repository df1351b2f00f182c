"""Fault injection in a running host over real Zenoh: planned faults, requested faults, refusals, and lost messages."""

import threading
import time
from typing import Any

import pytest

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.faults.injector import FaultInjector
from snakesim_hal.faults.message_faults import MessageFaults
from snakesim_hal.host.guarded_backend import GuardedBackend
from snakesim_hal.host.host import Host
from snakesim_hal.model.fault_kinds import parse_injection
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Answer, Clock, FaultRequest, JointState
from snakesim_testing.hal.local_network import (
    LagBackend,
    RunningHost,
    connected_sessions,
    running_commanded_host,
    running_host,
)
from snakesim_testing.hal.small_robots import (
    make_clock,
    make_description,
    make_joint_state,
    make_run_config,
)
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.messages import raises_error

INJECTION_ALLOWED: dict[str, Any] = {
    "clock_mode": "realtime",
    "rate_hz": 100,
    "allow_fault_injection": True,
}


def request_fault(run: RunningHost, kind: str, target: str, **options: Any) -> Answer:
    """Request a fault from the host, and return its answer."""
    return run.request(keys.fault_key("hal"), FaultRequest(kind=kind, target=target, **options))


@pytest.mark.quiet  # a lease of 50 ms
def test_injected_fault_lasts_until_ended_and_impossible_one_is_refused() -> None:
    with running_commanded_host(make_run_config(**INJECTION_ALLOWED)) as (run, _):
        for request, expected_refusal, expected_reason in (
            (FaultRequest(kind="mote", target="joint_1"), "cannot", "knows no 'mote'"),
            (
                FaultRequest(kind="mute", target="joint_9"),
                "cannot",
                "no joint_9; this robot has joint_1 to joint_3",
            ),
            (
                FaultRequest(kind="leak", target="joint_1"),
                "cannot",
                "backend 'lag' cannot do leak to joint_1",
            ),
            (FaultRequest(kind="kill", target="control"), "wrong_part", "is carried out by run"),
            (
                FaultRequest(kind="drop", target="actuator/joints"),
                "wrong_part",
                "is carried out by control",
            ),
            (
                FaultRequest(kind="mute", target="joint_1", end=True),
                "wrong_state",
                "is not active; active: nothing",
            ),
        ):
            answer = run.request(keys.fault_key("hal"), request)
            assert not answer.ok, request
            assert answer.refusal == expected_refusal, request
            assert expected_reason in answer.reason, request
        assert run.host.faults.notes == []
        answer = request_fault(run, "mute", "joint_2")
        assert answer.ok
        assert answer.reason.startswith("mute of joint_2 has begun, at ")
        assert answer.lifecycle == "armed"
        run.wait_for_lifecycle("fault")
        assert "joint_2" in run.status.reason
        (active_fault,) = run.status.injected
        assert active_fault.startswith("mute:joint_2@")
        assert request_fault(run, "mute", "joint_2", end=True).ok
        wait_until(lambda: run.status.injected == [], "the end of the fault")
        assert run.request_lifecycle("reset").ok
        run.arm()
        assert [text.split()[-1] for text in run.host.faults.notes] == ["begins", "ends"]
        assert all(text.startswith("tick ") for text in run.host.faults.notes)


def test_host_without_injection_permission_refuses_every_fault() -> None:
    with running_host(make_run_config(clock_mode="realtime")) as run:
        answer = request_fault(run, "mute", "joint_1")
        assert not answer.ok
        assert answer.refusal == "not_allowed"
        assert "allow_fault_injection = true" in answer.reason
    config = make_run_config(faults=["mute:joint_1@1"])
    with (
        connected_sessions("worm") as (session,),
        raises_error(ConfigError, code="injection/not-allowed"),
    ):
        Host(config, GuardedBackend(LagBackend(config)), session)


@pytest.mark.quiet  # a lease of 50 ms
def test_injected_plan_that_backend_refuses_is_a_fault() -> None:
    with running_commanded_host(
        make_run_config(faults=["leak:joint_1@0"], **INJECTION_ALLOWED)
    ) as (run, _):
        recorded = run.host.authority.faults_since_start
        wait_until(
            lambda: any(fault.what == "injection_refused" for fault in recorded.faults),
            "a fault in the run's record",
        )
        assert "is refused: backend 'lag' cannot do leak" in run.host.faults.notes[0]


def test_host_with_injected_hang_stops_and_resumes_ticks() -> None:
    with running_host(make_run_config(**INJECTION_ALLOWED)) as run:
        assert request_fault(run, "hang", "host").ok
        ticks_before = run.backend.advanced
        time.sleep(0.3)
        assert run.backend.advanced - ticks_before <= 2
        assert request_fault(run, "hang", "host", end=True).ok, (
            "a hanging host did not accept the request to end the fault"
        )
        wait_until(lambda: run.backend.advanced > ticks_before + 5, "ticks after the hang")
        assert request_fault(run, "hang", "host", for_s=0.1).ok
        ticks_before = run.backend.advanced
        wait_until(
            lambda: run.backend.advanced > ticks_before + 5,
            "ticks after a hang of limited duration",
        )


def test_sensor_samples_with_injected_drop_are_lost_until_end() -> None:
    with running_host(make_run_config(**INJECTION_ALLOWED)) as run:
        reader = run.session.declare_reader(keys.JOINTS, JointState)
        wait_until(reader.drain, "sensor samples")
        assert request_fault(run, "drop", keys.JOINTS, for_s=0.2).ok
        wait_until(lambda: run.host.faults.notes, "the begin of the fault")
        reader.drain()
        wait_until(lambda: len(run.host.faults.notes) == 2, "the end of the fault")
        begin_tick, end_tick = (int(text.split()[1].rstrip(":")) for text in run.host.faults.notes)
        ticks: list[int] = []
        wait_until(
            lambda: (
                ticks.extend(state.tick for state in reader.drain())
                or (ticks and ticks[-1] > end_tick)
            ),
            "new samples",
        )
        assert not set(ticks) & set(range(begin_tick, end_tick))


# --- rules of one injector ------------------------------------------------------------------------------------


def update_injector(injector: FaultInjector, tick: int, arm_session: int) -> None:
    """Update the injector for one control cycle of 10 ms. Arm session 0 means disarmed."""
    injector.update(tick * 10_000_000, arm_session, "armed" if arm_session else "disarmed")


def test_injected_plan_is_not_repeated_for_restarted_service() -> None:
    config = make_run_config(faults=["drop:actuator/joints@0.1"], allow_fault_injection=True)
    with connected_sessions("worm") as (session,):
        # A service that starts while the robot is already armed was restarted.
        for initial_arm_session, expected in ((0, ["drop:actuator/joints@0.1=1"]), (1, [])):
            injector = FaultInjector(
                "control", config, session, report_event=lambda _text, _now_s: None
            )
            update_injector(injector, 0, initial_arm_session)
            for tick in range(1, 15):
                update_injector(injector, tick, 1)
            assert injector.active == expected
            injector.close()


def test_injected_fault_is_replaced_by_newer_one_of_its_kind() -> None:
    config = make_run_config(
        faults=["drop:actuator/joints@0.1-0.3=0.5", "drop:actuator/joints@0.2-0.4"]
    )
    notes: list[str] = []
    with connected_sessions("worm") as (session,):
        injector = FaultInjector(
            "control",
            config,
            session,
            report_event=lambda text, now_s: notes.append(f"{now_s:g} {text}"),
        )
        for tick in range(50):
            update_injector(injector, tick, int(tick > 0))
        injector.close()
    assert notes == [
        "0.11 drop:actuator/joints@0.1-0.3=0.5 begins",
        "0.21 drop:actuator/joints@0.2-0.4=1 begins",
        "0.41 drop:actuator/joints@0.2-0.4=1 ends",
    ]


# --- faults of messages ---------------------------------------------------------------------------------------------


def test_injected_delay_delays_messages_and_ends_its_thread() -> None:
    with connected_sessions(None, None) as (sender, receiver):
        arrival_times_s: list[float] = []
        receiver.on_arrival(
            keys.CLOCK, lambda arrival: arrival_times_s.append(arrival.monotonic_ns * 1e-9)
        )
        publisher = sender.declare_publisher(keys.CLOCK, Clock)
        wait_until(publisher.has_subscriber, "a subscriber")
        direct_put = publisher._put
        faults = MessageFaults(sender, 1)
        delay = parse_injection("delay:hal/clock@0=0.1")
        faults.begin(delay)
        send_times_s = []
        for _ in range(5):
            send_times_s.append(time.monotonic())
            publisher.put(make_clock(1))
            time.sleep(0.02)
        assert any(thread.name == "late messages" for thread in threading.enumerate())
        faults.end(delay)
        wait_until(lambda: len(arrival_times_s) == 5, "all messages")
        assert all(
            0.1 <= arrival_s - send_s < 1.0
            for send_s, arrival_s in zip(send_times_s, arrival_times_s, strict=True)
        )
        wait_until(lambda: publisher._put == direct_put, "the direct path")
        wait_until(
            lambda: all(thread.name != "late messages" for thread in threading.enumerate()),
            "the end of the sending thread",
        )
        faults.close()


def test_injected_message_faults_cover_later_publishers_and_end() -> None:
    with connected_sessions(None, None) as (sender, receiver):
        payloads: list[bytes] = []
        receiver.on_arrival(keys.JOINTS, lambda arrival: payloads.append(arrival.payload))
        faults = MessageFaults(sender, 1)
        faults.begin(parse_injection("flood:sensor/joints@0=2000"))
        faults.begin(parse_injection("corrupt:sensor/joints@0=0.5"))
        publisher = sender.declare_publisher(keys.JOINTS, JointState)
        wait_until(publisher.has_subscriber, "a subscriber")
        publisher.put(make_joint_state(make_description()))
        wait_until(lambda: len(payloads) > 500, "a flood")
        assert 100 < len(set(payloads)) < len(payloads)
        faults.close()
        time.sleep(0.05)
        count = len(payloads)
        time.sleep(0.1)
        assert len(payloads) == count
