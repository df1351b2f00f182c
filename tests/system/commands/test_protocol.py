"""`schemas/protocol.md` and the meanings in the schemas are enough for a stranger, and say what the code does."""

import json
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, get_args

import pytest
import zenoh

from snakesim_gnc.control.service.state_reports import TELEMETRY_PERIOD_S
from snakesim_hal.host.status_reporter import STATUS_PERIOD_NS
from snakesim_hal.network.endpoint import DEFAULT_ENDPOINT
from snakesim_hal.network.session import ConnectionSettings, open_session
from snakesim_hal.safety import lifecycle, limiter
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import encode
from snakesim_hal.wire.messages import (
    VERSIONS,
    DepthImage,
    JointCommand,
    JointMode,
    JointState,
    RobotDescription,
    TickDone,
)
from snakesim_operator.this_computer.schemas import generate_contract_files
from snakesim_testing.hal.small_robots import make_description
from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.harness.wait import wait_until

REPOSITORY = Path(__file__).parents[3]
PROTOCOL = (REPOSITORY / "schemas" / "protocol.md").read_text(encoding="utf-8")


@cache
def published_contract() -> dict[str, str]:
    return dict(generate_contract_files())


def texts_in(schema: Any) -> Iterator[str]:
    """Every unit and description below a field."""
    if isinstance(schema, dict):
        yield from (schema[word] for word in ("unit", "description") if word in schema)
        schema = list(schema.values())
    if isinstance(schema, list):
        for inner in schema:
            yield from texts_in(inner)


@pytest.mark.parametrize("path", [f"messages/{message.__name__}.json" for message in VERSIONS])
def test_whole_numbers_flags_and_null_say_what_they_mean(path: str) -> None:
    for struct, schema in json.loads(published_contract()[path])["$defs"].items():
        for name, field in schema.get("properties", {}).items():
            if {"type": "null"} in field.get("anyOf", []):
                assert "null" in field.get("description", ""), f"{struct}.{name}"
            if field.get("type") in ("integer", "boolean"):
                assert list(texts_in(field)), f"{struct}.{name}"


def test_the_modes_are_told_with_their_numbers_and_units() -> None:
    reported = json.loads(published_contract()["messages/JointCommand.json"])["$defs"]["JointMode"][
        "description"
    ]
    for mode, unit in (
        (JointMode.PASSIVE, "ignored"),
        (JointMode.POSITION, "rad"),
        (JointMode.VELOCITY, "rad/s"),
        (JointMode.TORQUE, "N·m"),
    ):
        assert re.search(
            rf"^{mode.value} {mode.name.lower()}: .*\b{unit}$", reported, re.MULTILINE
        ), mode


def test_every_refusal_is_told() -> None:
    commands = {*get_args(limiter.RejectionReason), "before_arming"}
    source = "".join(
        (REPOSITORY / name).read_text(encoding="utf-8")
        for name in (
            "snakesim_hal/host/host.py",
            "snakesim_hal/host/request_handler.py",
            "snakesim_hal/safety/lease.py",
            "snakesim_hal/faults/injector.py",
            "snakesim_hal/wire/codec.py",
        )
    )
    words = set(re.findall(r'(?:refusal|word)="(\w+)"|_no\([^"]*"[^"]*", "(\w+)"\)', source))
    asked = {word for pair in words for word in pair if word} | set(lifecycle.REFUSAL_ORDER)
    assert len(asked) > len(lifecycle.REFUSAL_ORDER) + 3
    for word in commands | asked:
        assert f"`{word}`" in PROTOCOL, word


def test_the_rates_are_those_of_the_code() -> None:
    when = {row.key: row.when for row in keys.SPACE}
    assert f"{1e9 / STATUS_PERIOD_NS:g} Hz" in when[keys.STATUS]
    assert f"{1 / TELEMETRY_PERIOD_S:g} Hz" in when[keys.CONTROL_STATE]
    for row in keys.SPACE:
        assert f"| {row.kind} | {row.when} |" in published_contract()["keys.md"]


def test_the_endpoint_is_the_default() -> None:
    assert f"| endpoint | `{DEFAULT_ENDPOINT}`" in PROTOCOL


ROWS = {
    "`actuator/joints`": (keys.JOINT_COMMAND, JointCommand),
    "`hal/clock`, `hal/done/*`": (keys.done_key("control"), TickDone),
    "`sensor/depth/*`, `sensor/color/*`": (keys.depth_key("head"), DepthImage),
    "other streams": (keys.JOINTS, JointState),
    "`hal/description`, `hal/status`": (keys.DESCRIPTION, RobotDescription),
}


@pytest.mark.parametrize("lossless", [False, True], ids=["realtime", "lockstep"])
@pytest.mark.parametrize("name", ROWS)
def test_streams_are_sent_with_the_priorities_of_the_table(name: str, lossless: bool) -> None:
    (key, message), endpoint = ROWS[name], find_free_endpoint()
    row = next(line for line in PROTOCOL.splitlines() if line.startswith(f"| {name} |"))
    priority, congestion, express = (cell.strip() for cell in row.strip("|").split("|")[1:])
    latched = key == keys.DESCRIPTION
    with (
        open_session(ConnectionSettings(endpoint, "worm", listen=True)) as hal,
        plain(endpoint) as stranger,
    ):
        arrived = stranger.declare_subscriber(key)
        publisher = (
            hal.declare_latched_publisher(key, message)
            if latched
            else hal.declare_publisher(key, message, lossless=lossless)
        )
        found: list[zenoh.Sample] = []
        wait_until(
            lambda: (
                publisher.send(b"") or found.extend(filter(None, [arrived.try_recv()])) or found
            ),
            "a sample",
        )
    assert str(found[0].priority).endswith(f".{priority}")
    assert found[0].express == (express == "yes")
    blocks = lossless and not latched
    wanted = zenoh.CongestionControl.BLOCK if blocks else zenoh.CongestionControl.DROP
    assert found[0].congestion_control == wanted
    assert congestion.startswith("DROP")
    assert ("lockstep BLOCK" in congestion) != latched


def test_a_plain_client_gets_the_latched_description_by_a_query() -> None:
    endpoint, robot = find_free_endpoint(), make_description()
    with open_session(ConnectionSettings(endpoint, "worm", listen=True)) as hal:
        hal.declare_latched_publisher(keys.DESCRIPTION, RobotDescription).put(robot)
        with plain(endpoint) as stranger:
            assert "`hal/description/@adv/**`" in PROTOCOL
            replies = list(
                stranger.get(
                    "hal/description/@adv/**", accept_replies=zenoh.ReplyKeyExpr.ANY, timeout=5.0
                )
            )
    assert [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None] == [
        encode(robot)
    ]


def plain(endpoint: str) -> zenoh.Session:
    """A session as the protocol describes it."""
    link = {"mode": "client", "namespace": "worm", "connect": {"endpoints": [endpoint]}}
    quiet = {"multicast": {"enabled": False}, "gossip": {"enabled": False}}
    return zenoh.open(zenoh.Config.from_json5(json.dumps({**link, "scouting": quiet})))
