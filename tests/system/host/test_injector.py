"""Faults on request in a running host, over real Zenoh: planned, asked for, refused, and on the wire."""

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

ALLOWED: dict[str, Any] = {"clock_mode": "realtime", "rate_hz": 100, "allow_fault_injection": True}


def ask(run: RunningHost, kind: str, target: str, **more: Any) -> Answer:
    return run.request(keys.fault_key("hal"), FaultRequest(kind=kind, target=target, **more))


@pytest.mark.quiet  # a lease of 50 ms
def test_injected_fault_lasts_until_ended_and_impossible_one_is_refused() -> None:
    with running_commanded_host(make_run_config(**ALLOWED)) as (run, _):
        for asked, refusal, words in (
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
            answer = run.request(keys.fault_key("hal"), asked)
            assert not answer.ok and answer.refusal == refusal and words in answer.reason, asked
        assert run.host.faults.notes == []
        answer = ask(run, "mute", "joint_2")
        assert answer.ok
        assert answer.reason.startswith("mute of joint_2 has begun, at ")
        assert answer.lifecycle == "armed"
        run.wait_for_lifecycle("fault")
        assert "joint_2" in run.status.reason
        (on,) = run.status.injected
        assert on.startswith("mute:joint_2@")
        assert ask(run, "mute", "joint_2", end=True).ok
        wait_until(lambda: run.status.injected == [], "an end of it")
        assert run.request_lifecycle("reset").ok
        run.arm()
        assert [text.split()[-1] for text in run.host.faults.notes] == ["begins", "ends"]
        assert all(text.startswith("tick ") for text in run.host.faults.notes)


def test_where_something_real_moves_nothing_goes_wrong_on_request() -> None:
    with running_host(make_run_config(clock_mode="realtime")) as run:
        answer = ask(run, "mute", "joint_1")
        assert not answer.ok
        assert answer.refusal == "not_allowed"
        assert "allow_fault_injection = true" in answer.reason
    config = make_run_config(faults=["mute:joint_1@1"])
    with (
        connected_sessions("worm") as (own,),
        raises_error(ConfigError, code="injection/not-allowed"),
    ):
        Host(config, GuardedBackend(LagBackend(config)), own)


@pytest.mark.quiet  # a lease of 50 ms
def test_injected_plan_that_fails_is_a_fault_of_the_run() -> None:
    with running_commanded_host(make_run_config(faults=["leak:joint_1@0"], **ALLOWED)) as (run, _):
        told = run.host.authority.faults_since_start
        wait_until(
            lambda: any(fault.what == "injection_refused" for fault in told.faults),
            "a word about it",
        )
        assert "is refused: backend 'lag' cannot do leak" in run.host.faults.notes[0]


def test_a_hanging_host_does_nothing_and_goes_on_afterwards() -> None:
    with running_host(make_run_config(**ALLOWED)) as run:
        assert ask(run, "hang", "host").ok
        before = run.backend.advanced
        time.sleep(0.3)
        assert run.backend.advanced - before <= 2
        assert ask(run, "hang", "host", end=True).ok, (
            "a hanging host still takes the request to end it"
        )
        wait_until(lambda: run.backend.advanced > before + 5, "the host going on")
        assert ask(run, "hang", "host", for_s=0.1).ok
        before = run.backend.advanced
        wait_until(lambda: run.backend.advanced > before + 5, "the host going on by itself")


def test_sensors_that_are_dropped_do_not_arrive_and_come_back() -> None:
    with running_host(make_run_config(**ALLOWED)) as run:
        reader = run.session.declare_reader(keys.JOINTS, JointState)
        wait_until(reader.drain, "sensor samples")
        assert ask(run, "drop", keys.JOINTS, for_s=0.2).ok
        wait_until(lambda: run.host.faults.notes, "its begin")
        reader.drain()
        wait_until(lambda: len(run.host.faults.notes) == 2, "its end")
        begin, end = (int(text.split()[1].rstrip(":")) for text in run.host.faults.notes)
        ticks: list[int] = []
        wait_until(
            lambda: ticks.extend(j.tick for j in reader.drain()) or (ticks and ticks[-1] > end),
            "new samples",
        )
        assert not set(ticks) & set(range(begin, end))


# --- a part's own rules --------------------------------------------------------------------------------------


def turn(injector: FaultInjector, tick: int, arm_session: int) -> None:
    injector.update(tick * 10_000_000, arm_session, "armed" if arm_session else "disarmed")


def test_injected_plan_is_not_repeated_for_restarted_service() -> None:
    config = make_run_config(faults=["drop:actuator/joints@0.1"], allow_fault_injection=True)
    with connected_sessions("worm") as (session,):
        for first_arming, expected in ((0, ["drop:actuator/joints@0.1=1"]), (1, [])):
            injector = FaultInjector(
                "control", config, session, report_event=lambda _text, _now_s: None
            )
            turn(injector, 0, first_arming)
            for tick in range(1, 15):
                turn(injector, tick, 1)
            assert injector.active == expected
            injector.close()


def test_injected_newer_fault_replaces_one_of_its_kind() -> None:
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
            turn(injector, tick, int(tick > 0))
        injector.close()
    assert notes == [
        "0.11 drop:actuator/joints@0.1-0.3=0.5 begins",
        "0.21 drop:actuator/joints@0.2-0.4=1 begins",
        "0.41 drop:actuator/joints@0.2-0.4=1 ends",
    ]


# --- on the wire ---------------------------------------------------------------------------------------------


def test_injected_delay_ends_with_its_sending_thread() -> None:
    with connected_sessions(None, None) as (here, there):
        arrived: list[float] = []
        there.on_arrival(keys.CLOCK, lambda arrival: arrived.append(arrival.monotonic_ns * 1e-9))
        publisher = here.declare_publisher(keys.CLOCK, Clock)
        wait_until(publisher.has_subscriber, "a subscriber")
        straight = publisher._put
        faults, delay = MessageFaults(here, 1), parse_injection("delay:hal/clock@0=0.1")
        faults.begin(delay)
        sent_at = []
        for _ in range(5):
            sent_at.append(time.monotonic())
            publisher.put(make_clock(1))
            time.sleep(0.02)
        assert any(thread.name == "late messages" for thread in threading.enumerate())
        faults.end(delay)
        wait_until(lambda: len(arrived) == 5, "all of them")
        assert all(
            0.1 <= there_s - here_s < 1.0 for here_s, there_s in zip(sent_at, arrived, strict=True)
        )
        wait_until(lambda: publisher._put == straight, "the straight way again")
        wait_until(
            lambda: all(t.name != "late messages" for t in threading.enumerate()), "the thread gone"
        )
        faults.close()


def test_injected_disturbance_covers_later_publishers_and_flood_ends() -> None:
    with connected_sessions(None, None) as (here, there):
        arrived: list[bytes] = []
        there.on_arrival(keys.JOINTS, lambda arrival: arrived.append(arrival.payload))
        faults = MessageFaults(here, 1)
        faults.begin(parse_injection("flood:sensor/joints@0=2000"))
        faults.begin(parse_injection("corrupt:sensor/joints@0=0.5"))
        publisher = here.declare_publisher(keys.JOINTS, JointState)
        wait_until(publisher.has_subscriber, "a subscriber")
        publisher.put(make_joint_state(make_description()))
        wait_until(lambda: len(arrived) > 500, "a flood")
        assert 100 < len(set(arrived)) < len(arrived)
        faults.close()
        time.sleep(0.05)
        count = len(arrived)
        time.sleep(0.1)
        assert len(arrived) == count
