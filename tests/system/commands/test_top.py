"""`snakesim topic rate`: what it makes of arrivals, of a stranger's too, and that nobody can make it grow."""

import itertools
import json
import threading

import pytest

from snakesim_hal.network.session import ConnectionSettings, Session, open_session
from snakesim_hal.network.streams import ReceivedSample
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import encode, format_encoding
from snakesim_hal.wire.messages import Clock, JointState, Message
from snakesim_operator.base.targets import RobotSelection
from snakesim_operator.monitoring.top import TrafficSnapshot, show_traffic
from snakesim_operator.monitoring.traffic import MAX_ARRIVAL_TIMES, MAX_KEYS, NetworkTraffic
from snakesim_testing.hal.small_robots import (
    make_clock,
    make_description,
    make_joint_command,
    make_joint_state,
)
from snakesim_testing.harness.endpoint import find_free_endpoint

MS = 1_000_000


def arrival(key: str, message: Message, at_ms: float) -> ReceivedSample:
    return ReceivedSample(key, encode(message), format_encoding(type(message)), round(at_ms * MS))


def test_rates_ages_and_latencies_are_those_of_the_arrivals() -> None:
    robot, traffic = make_description(), NetworkTraffic()
    for tick in range(100):
        traffic.add(
            arrival(
                "lab/worm/sensor/joints",
                make_joint_state(robot, tick=tick, timestamp_ns=tick * 10 * MS),
                10 * tick,
            )
        )
        traffic.add(arrival("lab/worm/hal/clock", make_clock(tick + 2), 10 * tick + 1))
        answer = make_joint_command(robot, tick=tick, sequence=tick)
        traffic.add(arrival("lab/worm/actuator/joints", answer, 10 * tick + 3))
    lines = {line.key: line for line in traffic.measure_keys(1000 * MS)}
    joints = lines[keys.JOINTS]
    assert joints.robot == "lab/worm"
    assert joints.writer == "HAL"
    assert joints.rate_hz == pytest.approx(100.0)
    assert joints.jitter_ms == pytest.approx(0.0, abs=1e-9)
    assert joints.received_ago_s == pytest.approx(0.01)
    assert joints.age_ms == pytest.approx(20.0)
    (latency,) = traffic.measure_latencies()
    assert (latency.arrival_median_ms, latency.arrival_p99_ms, latency.count) == pytest.approx(
        (3.0, 3.0, 100)
    )


def test_top_foreign_keys_are_bounded_and_harmless_to_terminal() -> None:
    traffic = NetworkTraffic("worm")
    traffic.add(ReceivedSample("sensor/joints", b"noise", format_encoding(JointState), 0))
    for i in range(MAX_KEYS + 10):
        traffic.add(ReceivedSample(f"evil/{i}", b"x", "", i))
    for i in range(2 * MAX_ARRIVAL_TIMES):
        traffic.add(ReceivedSample("evil/0", b"x", "", i * MS))
    lines = traffic.measure_keys(MS)
    assert len(lines) == MAX_KEYS
    assert traffic.keys_left_out == 11
    assert lines[0].failure == "malformed"
    assert lines[1].writer is None
    text = "\n".join(TrafficSnapshot(lines, [], {}, {}, traffic.keys_left_out).format_table())
    assert "UNKNOWN" in text
    assert "11 messages on still more keys" in text


def test_a_table_for_scripts_from_a_real_network() -> None:
    endpoint, over = find_free_endpoint(), threading.Event()
    lines: list[str] = []

    def tell_time(session: Session) -> None:
        publisher = session.declare_publisher(keys.CLOCK, Clock)
        for tick in itertools.count():
            publisher.put(make_clock(tick))
            if over.wait(0.02):
                return

    with open_session(ConnectionSettings(endpoint, "worm", listen=True)) as session:
        teller = threading.Thread(target=tell_time, args=(session,))
        teller.start()
        try:
            assert (
                show_traffic(RobotSelection(endpoint), lines.append, once=True, as_json=True) == 0
            )
        finally:
            over.set()
            teller.join()
    (line,) = json.loads(lines[0])["keys"]
    assert line["robot"] == "worm"
    assert line["key"] == "hal/clock"
    assert line["writer"] == "HAL"
    assert 10 < line["rate_hz"] < 60
