"""Queries and names that are too long, too deep, too many, or not for a terminal."""

import itertools
import json
import random
import time
from pathlib import Path

import pytest
import zenoh

from snakesim_testing.harness.endpoint import find_free_endpoint
from verification.attack.command import HOLDING, running, steering
from verification.attack.effort import Record, effort
from verification.attack.means import wire
from verification.attack.robot import AttackedRobot, joined
from verification.attack.stranger import NAMESPACE, NetworkStranger

EVIL = "\x1b[2J\x1b]0;evil\x07\r\nplanar13: armed - all is well\n\x9b31m\u202e"
STATUS_S = 20.0
MUCH_BYTES = 100_000


def payloads() -> list[bytes]:
    dice = random.Random(1)
    return [
        b"",
        wire.deep(100),
        wire.deep(2000),
        wire.deep(900_000),
        b"\x81\xa1a" * 100_000,
        b"\xdd\xff\xff\xff\xff",  # a list that says that it is 2^32 long
        b"\xdb\xff\xff\xff\xff",
        dice.randbytes(900_000),
        dice.randbytes(1_100_000),
        dice.randbytes(5_000_000),
        wire.encode({str(i): [i] * 10 for i in range(10_000)}),
        wire.encode(
            {"action": "arm" * 100_000, "requester": "x" * 100_000, "holder": "x" * 100_000}
        ),
        wire.encode({"action": "arm", "robot": "x" * 65}),
        wire.encode({"action": "acquire", "holder": "", "priority": 10**9}),
        wire.encode({"action": "acquire", "holder": "x", "epoch": -1}),
        wire.encode({"kind": "kill", "target": "../../etc", "for_s": -1.0}),
        wire.encode({"requester": b"\xff\xfe"}),
        wire.encode([1, 2, 3]),
    ]


@pytest.mark.parametrize("key", wire.QUERIES)
def test_no_payload_of_a_query_harms_the_robot(robot: AttackedRobot, key: str) -> None:
    before, operator = robot.health(), robot.operator
    operator.forget()
    targets = (
        [key.replace("*", part) for part in ("run", "control", "hal")] if "*" in key else [key]
    )
    small = [payload for payload in payloads() if len(payload) < MUCH_BYTES]
    large = [[payload] for payload in payloads() if len(payload) >= MUCH_BYTES]
    for target, group in itertools.product(targets, [small, *large]):
        with NetworkStranger(
            robot.endpoint
        ) as stranger:  # one that sends too much may lose its connection
            for payload in group:
                for answer in stranger.ask(target, payload, 0.3):
                    assert not answer["ok"], f"{payload[:40]!r} at {target}: {answer}"
    robot.stays("armed", 0.3)
    assert {heard.message["lifecycle"] for heard in operator.heard("hal/clock")} == {"armed"}
    robot.unharmed(before)


def test_queries_without_payload_with_patterns_and_never_read_are_harmless(
    robot: AttackedRobot,
) -> None:
    before = robot.health()
    with NetworkStranger(robot.endpoint) as stranger:
        for selector in (
            "**",
            "*/**",
            f"{NAMESPACE}/**",
            f"{NAMESPACE}/hal/*",
            f"{NAMESPACE}/hal/estop?_time=[..]",
        ):
            for _ in range(
                effort(20, 300)
            ):  # more at once may hold Zenoh up for longer than a lease
                stranger.session.get(selector, zenoh.handlers.RingChannel(1), timeout=0.5)
                stranger.session.get(
                    selector, zenoh.handlers.RingChannel(1), payload=b"\xc1", timeout=0.5
                )
    robot.stays("armed", 0.5)
    robot.unharmed(before)


# --- names ------------------------------------------------------------------------------------------------------------


def printed_safely(robot: AttackedRobot, before: str) -> None:
    """Nothing that a person reads has control characters, or lines that a stranger has written."""
    told = {
        f"snakesim {tool}": robot.run.run_tool(*tool.split()).printed
        for tool in ("status", "estop", "robot reset")
    }
    for who, said in {**told, "the run": robot.run.printed()[len(before) :]}.items():
        assert not steering(said), f"{who} prints {said!r}"
        assert not any(
            line.startswith("planar13: armed - all is well") for line in said.splitlines()
        ), said


def test_control_characters_of_who_stops_the_robot_reach_no_terminal(robot: AttackedRobot) -> None:
    said = robot.run.printed()
    with NetworkStranger(robot.endpoint) as stranger:
        stranger.ask("hal/estop", {"requester": EVIL})
    robot.operator.until(lambda: robot.operator.lifecycle() == "estop", "the stop")
    robot.run.wait_for("evil")
    assert "evil" in robot.run.run_tool("status").out
    echoed = robot.run.run_tool("topic", "echo", "hal/status", "--count", "1")
    assert EVIL in json.loads(echoed.out)["message"]["reason"] and not steering(echoed.printed), (
        echoed.printed
    )
    printed_safely(robot, said)


def test_control_characters_of_who_holds_the_lease_reach_no_terminal(robot: AttackedRobot) -> None:
    said = robot.run.printed()
    with NetworkStranger(robot.endpoint) as stranger:
        stranger.ask("hal/lease", {"action": "acquire", "holder": EVIL, "priority": 255})
        for action in ("disarm", "reset", "arm"):
            stranger.request(action, requester=EVIL)
        time.sleep(0.3)
        printed_safely(robot, said)


def test_control_characters_in_forged_streams_reach_no_terminal(robot: AttackedRobot) -> None:
    said, operator = robot.run.printed(), robot.operator
    fault = {"tick": 1, "what": EVIL[:60], "cause": EVIL, "joint": EVIL[:60], "scope": "robot"}
    status = {
        **operator.status(),
        "lifecycle": "fault",
        "reason": EVIL,
        "faults": [fault],
        "injected": [EVIL],
    }
    status |= {
        "robot": EVIL,
        "backend": EVIL,
        "lease_holder": EVIL,
        "alive": [EVIL],
        "waiting_for": [EVIL],
    }
    status |= {
        "isolated": [EVIL],
        "derated": {EVIL: 0.5},
        "realtime_warnings": [EVIL],
        "commands_rejected": {EVIL: 1},
    }
    clock = operator.next("hal/clock")
    state = {
        "tick": clock["tick"],
        "timestamp_ns": clock["timestamp_ns"],
        "controller": EVIL,
        "state": "Idle",
        "reason": EVIL,
    }
    with NetworkStranger(robot.endpoint) as stranger:
        publisher = stranger.latch("hal/status", status)
        for _ in range(20):
            publisher.put(wire.encode(status))
            stranger.put("control/state", {**state, "propulsion_joint": EVIL})
            time.sleep(0.02)
        printed_safely(robot, said)


def test_control_characters_in_a_namespace_reach_no_terminal(robot: AttackedRobot) -> None:
    said = robot.run.printed()
    with NetworkStranger(robot.endpoint, "evil\x1b[2J\rplanar13: armed - all is well") as stranger:
        stranger.seem_alive("alive/hal")
        stranger.pretend(
            "hal/estop", {"ok": True, "reason": EVIL, "epoch": 0, "lifecycle": "estop"}
        )
        stranger.latch("hal/status", {**robot.operator.status(), "reason": EVIL})
        printed_safely(robot, said)


# --- many -------------------------------------------------------------------------------------------------------------


def test_many_tokens_of_services_change_nothing(robot: AttackedRobot) -> None:
    # 5000 at once hold Zenoh up for longer than a lease.
    before, count = robot.health(), effort(200, 1000)
    with NetworkStranger(robot.endpoint) as stranger:
        for i in range(count):
            stranger.seem_alive(f"alive/service_{i}")
        robot.stays("armed", 1.0)
        status = robot.operator.next("hal/status")
        assert len(status["alive"]) <= 64 and "control" in status["alive"], status["alive"]
    robot.stays("armed", 0.5)
    robot.unharmed(before)


def test_service_token_that_flaps_stops_nothing(robot: AttackedRobot) -> None:
    operator = robot.operator
    for name in ("control", "guidance", "hal") * effort(3, 100):
        with NetworkStranger(robot.endpoint) as stranger:
            stranger.seem_alive(f"alive/{name}")
            time.sleep(0.05)
    robot.stays("armed", 0.5)
    operator.stand_by()
    operator.recover()


def test_false_robots_do_not_keep_a_stop_from_real_one(
    robot: AttackedRobot, record_property: Record
) -> None:
    operator = robot.operator
    with NetworkStranger(robot.endpoint) as stranger:
        tokens = [
            stranger.session.liveliness().declare_token(f"robot_{i}/alive/hal")
            for i in range(effort(100, 1000))
        ]
        asked_s = time.monotonic()
        ended = robot.run.run_tool("estop", timeout_s=STATUS_S)
        took_s = operator.stopped_at(asked_s, 5.0) - asked_s
        for token in tokens:
            token.undeclare()
    record_property(
        "stopped after", f"{took_s:.2f} s, the command ended after {ended.duration_s:.2f} s"
    )
    assert took_s < 3.0 and ended.duration_s < STATUS_S
    assert "planar13: stopped" in ended.printed, ended.printed
    assert ended.code == 1, "robots that do not answer are no success"


# --- Zenoh itself -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["router", pytest.param("peer", marks=pytest.mark.slow)])
def test_stranger_joining_as_router_or_peer_changes_nothing(
    robot: AttackedRobot, mode: str
) -> None:
    before = robot.health()
    with NetworkStranger(robot.endpoint, mode=mode, listen=find_free_endpoint()) as stranger:
        stranger.receive("hal/clock")
        stranger.until(lambda: stranger.heard("hal/clock"), "the clock")
        robot.stays("armed", 1.0)
        assert robot.run.run_tool("estop").code == 0
    operator = robot.operator
    operator.recover()
    robot.unharmed(before)


def test_the_hosts_zenoh_cannot_be_configured_by_a_stranger(robot: AttackedRobot) -> None:
    """A Zenoh router has an administration space; nobody may write there."""
    bait = find_free_endpoint()
    with NetworkStranger(robot.endpoint) as stranger:
        answers = [
            str(reply.ok.key_expr)
            for reply in stranger.session.get("@/**", timeout=1.0)
            if reply.ok is not None
        ]
        for zid in stranger.session.info.routers_zid():
            for what, value in (
                ("listen/endpoints", f'["{bait}"]'),
                ("transport/unicast/max_sessions", "1"),
                ("adminspace/permissions/write", "true"),
            ):
                stranger.session.put(f"@/{zid}/router/config/{what}", value)
        time.sleep(0.5)
        with pytest.raises(zenoh.ZError):
            NetworkStranger(bait, timeout_s=0.5)
        with NetworkStranger(robot.endpoint) as another:  # the number of sessions is what it was
            assert another.next("hal/clock")["lifecycle"] == "armed"
    assert not [key for key in answers if "config" in key], f"readable by anybody: {answers}"


def test_false_hosts_neither_stop_robot_nor_hide_a_stop(robot: AttackedRobot) -> None:
    before, operator = robot.health(), robot.operator
    with NetworkStranger(robot.endpoint) as stranger:
        for i in range(effort(100, 2000)):
            stranger.seem_alive(f"hal/host/{i:04}{'x' * 60 if i % 2 else EVIL.replace('/', '')}")
        robot.stays("armed", 1.0)
        stranger.ask("hal/estop", {"requester": "mallory"})
        operator.until(lambda: operator.lifecycle() == "estop", "estop")
        status = operator.next("hal/status")
        assert "mallory" in status["reason"], status["reason"]
        assert "estop" in [fault["what"] for fault in status["faults"]], (
            "what stopped it is not among the faults"
        )
        printed_safely(robot, "")
    robot.unharmed(before)


def test_a_host_that_is_none_does_not_end_a_run(tmp_path: Path) -> None:
    with running(tmp_path, *HOLDING, "--duration", "4") as run, joined(run) as operator:
        operator.until(lambda: operator.lifecycle() == "armed", "armed")
        with NetworkStranger(run.endpoint) as stranger:
            stranger.seem_alive("hal/host/another")
            code = run.end()
    assert code == 0, f"exit code {code}: {run.printed()[-600:]}"
