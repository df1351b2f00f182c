"""Payloads of queries that are empty, random, too long, too deep or wrong: none of them harms the robot."""

import itertools
import random

import pytest
import zenoh

from verification.attack.client import NAMESPACE, NetworkClient
from verification.attack.effort import choose_effort
from verification.attack.robot import AttackedRobot
from verification.attack.tools import wire

LARGE_BYTES = 100_000  # from this size on, a payload gets a connection of its own
ANSWER_TIMEOUT_S = 0.3
FAULT_TARGETS = ("run", "control", "hal")  # that replace the pattern in `fault/*`


def make_wrong_payloads() -> list[bytes]:
    """Return payloads that no robot may accept as a request."""
    generator = random.Random(1)
    return [
        b"",
        wire.make_nested_list_payload(100),
        wire.make_nested_list_payload(2000),
        wire.make_nested_list_payload(900_000),
        b"\x81\xa1a" * 100_000,
        b"\xdd\xff\xff\xff\xff",  # the header of a list with 2^32 - 1 elements
        b"\xdb\xff\xff\xff\xff",  # the header of a text with 2^32 - 1 bytes
        generator.randbytes(900_000),
        generator.randbytes(1_100_000),
        generator.randbytes(5_000_000),
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


def group_payloads() -> list[list[bytes]]:
    """Return groups of payloads that one client sends. A client that sends too much may lose its connection."""
    small: list[bytes] = []
    large: list[list[bytes]] = []
    for payload in make_wrong_payloads():
        if len(payload) < LARGE_BYTES:
            small.append(payload)
        else:
            large.append([payload])
    return [small, *large]


@pytest.mark.parametrize("key", wire.QUERY_KEYS)
def test_no_payload_of_a_query_harms_the_robot(robot: AttackedRobot, key: str) -> None:
    health = robot.record_health()
    operator = robot.operator
    operator.discard_streams()
    targets = [key]
    if "*" in key:
        targets = [key.replace("*", target) for target in FAULT_TARGETS]
    for target, payloads in itertools.product(targets, group_payloads()):
        with NetworkClient(robot.endpoint) as attacker:
            for payload in payloads:
                for answer in attacker.query(target, payload, ANSWER_TIMEOUT_S):
                    assert not answer["ok"], f"{payload[:40]!r} to {target}: {answer}"
    robot.assert_stays("armed", 0.3)
    lifecycles = {clock["lifecycle"] for clock in operator.list_messages("hal/clock")}
    assert lifecycles == {"armed"}
    robot.assert_unharmed(health)


def test_queries_with_pattern_or_unread_answer_are_harmless(robot: AttackedRobot) -> None:
    health = robot.record_health()
    selectors = (
        "**",
        "*/**",
        f"{NAMESPACE}/**",
        f"{NAMESPACE}/hal/*",
        f"{NAMESPACE}/hal/estop?_time=[..]",
    )
    # More queries at once may delay Zenoh for longer than a lease.
    query_count = choose_effort(20, 300)
    with NetworkClient(robot.endpoint) as attacker:
        for selector, _ in itertools.product(selectors, range(query_count)):
            for payload in (None, b"\xc1"):
                unread_channel = zenoh.handlers.RingChannel(1)
                attacker.session.get(selector, unread_channel, payload=payload, timeout=0.5)
    robot.assert_stays("armed", 0.5)
    robot.assert_unharmed(health)
