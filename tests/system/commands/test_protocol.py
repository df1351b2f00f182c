"""`schemas/protocol.md` and the descriptions in the schemas agree with the code, and suffice to write a client."""

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
def generate_files_by_path() -> dict[str, str]:
    """Return the published schema files, generated from the code."""
    return dict(generate_contract_files())


def iterate_descriptions(schema: Any) -> Iterator[str]:
    """Yield every unit and description in a schema and below it."""
    if isinstance(schema, dict):
        yield from (schema[key] for key in ("unit", "description") if key in schema)
        schema = list(schema.values())
    if isinstance(schema, list):
        for inner in schema:
            yield from iterate_descriptions(inner)


@pytest.mark.parametrize("path", [f"messages/{message.__name__}.json" for message in VERSIONS])
def test_schema_integers_flags_and_nulls_have_descriptions(path: str) -> None:
    for struct, schema in json.loads(generate_files_by_path()[path])["$defs"].items():
        for name, field in schema.get("properties", {}).items():
            if {"type": "null"} in field.get("anyOf", []):
                assert "null" in field.get("description", ""), f"{struct}.{name}"
            if field.get("type") in ("integer", "boolean"):
                assert list(iterate_descriptions(field)), f"{struct}.{name}"


def test_schema_joint_modes_have_numbers_and_units() -> None:
    schema = json.loads(generate_files_by_path()["messages/JointCommand.json"])
    description = schema["$defs"]["JointMode"]["description"]
    for mode, unit in (
        (JointMode.PASSIVE, "ignored"),
        (JointMode.POSITION, "rad"),
        (JointMode.VELOCITY, "rad/s"),
        (JointMode.TORQUE, "N·m"),
    ):
        assert re.search(
            rf"^{mode.value} {mode.name.lower()}: .*\b{unit}$", description, re.MULTILINE
        ), mode


def test_protocol_page_lists_every_refusal_code() -> None:
    command_refusals = {*get_args(limiter.RejectionReason), "before_arming"}
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
    matches = set(re.findall(r'(?:refusal|word)="(\w+)"|_no\([^"]*"[^"]*", "(\w+)"\)', source))
    request_refusals = {code for groups in matches for code in groups if code}
    request_refusals |= set(lifecycle.REFUSAL_ORDER)
    assert len(request_refusals) > len(lifecycle.REFUSAL_ORDER) + 3
    for code in command_refusals | request_refusals:
        assert f"`{code}`" in PROTOCOL, code


def test_key_table_has_the_rates_of_the_code() -> None:
    rates_by_key = {row.key: row.when for row in keys.SPACE}
    assert f"{1e9 / STATUS_PERIOD_NS:g} Hz" in rates_by_key[keys.STATUS]
    assert f"{1 / TELEMETRY_PERIOD_S:g} Hz" in rates_by_key[keys.CONTROL_STATE]
    for row in keys.SPACE:
        assert f"| {row.kind} | {row.when} |" in generate_files_by_path()["keys.md"]


def test_protocol_page_names_the_default_endpoint() -> None:
    assert f"| endpoint | `{DEFAULT_ENDPOINT}`" in PROTOCOL


TABLE_ROWS = {  # first cell of a row in the table of priorities: one of its keys, and its message
    "`actuator/joints`": (keys.JOINT_COMMAND, JointCommand),
    "`hal/clock`, `hal/done/*`": (keys.done_key("control"), TickDone),
    "`sensor/depth/*`, `sensor/color/*`": (keys.depth_key("head"), DepthImage),
    "other streams": (keys.JOINTS, JointState),
    "`hal/description`, `hal/status`": (keys.DESCRIPTION, RobotDescription),
}


@pytest.mark.parametrize("lossless", [False, True], ids=["realtime", "lockstep"])
@pytest.mark.parametrize("name", TABLE_ROWS)
def test_streams_have_priorities_of_the_protocol_table(name: str, lossless: bool) -> None:
    key, message = TABLE_ROWS[name]
    endpoint = find_free_endpoint()
    row = next(line for line in PROTOCOL.splitlines() if line.startswith(f"| {name} |"))
    priority, congestion, express = (cell.strip() for cell in row.strip("|").split("|")[1:])
    latched = key == keys.DESCRIPTION
    with (
        open_session(ConnectionSettings(endpoint, "worm", listen=True)) as host,
        open_plain_session(endpoint) as client,
    ):
        subscriber = client.declare_subscriber(key)
        if latched:
            publisher = host.declare_latched_publisher(key, message)
        else:
            publisher = host.declare_publisher(key, message, lossless=lossless)
        samples: list[zenoh.Sample] = []
        wait_until(
            lambda: (
                publisher.send(b"")
                or samples.extend(filter(None, [subscriber.try_recv()]))
                or samples
            ),
            "a sample",
        )
    assert str(samples[0].priority).endswith(f".{priority}")
    assert samples[0].express == (express == "yes")
    blocks = lossless and not latched
    expected_control = zenoh.CongestionControl.BLOCK if blocks else zenoh.CongestionControl.DROP
    assert samples[0].congestion_control == expected_control
    assert congestion.startswith("DROP")
    assert ("lockstep BLOCK" in congestion) != latched


def test_plain_client_gets_latched_description_by_query() -> None:
    endpoint = find_free_endpoint()
    description = make_description()
    with open_session(ConnectionSettings(endpoint, "worm", listen=True)) as host:
        host.declare_latched_publisher(keys.DESCRIPTION, RobotDescription).put(description)
        with open_plain_session(endpoint) as client:
            assert "`hal/description/@adv/**`" in PROTOCOL
            replies = list(
                client.get(
                    "hal/description/@adv/**", accept_replies=zenoh.ReplyKeyExpr.ANY, timeout=5.0
                )
            )
    payloads = [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]
    assert payloads == [encode(description)]


def open_plain_session(endpoint: str) -> zenoh.Session:
    """Open a Zenoh session with only the settings that the protocol describes."""
    connection = {"mode": "client", "namespace": "worm", "connect": {"endpoints": [endpoint]}}
    scouting = {"multicast": {"enabled": False}, "gossip": {"enabled": False}}
    return zenoh.open(zenoh.Config.from_json5(json.dumps({**connection, "scouting": scouting})))
