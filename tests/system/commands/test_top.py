"""`snakesim topic rate` measures rates and latencies of messages, and bounds the table for unknown keys."""

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

NS_PER_MS = 1_000_000


def make_sample(key: str, message: Message, arrival_ms: float) -> ReceivedSample:
    """Return a received sample with its arrival time."""
    encoding = format_encoding(type(message))
    return ReceivedSample(key, encode(message), encoding, round(arrival_ms * NS_PER_MS))


def test_topic_rate_measures_rates_ages_and_latencies() -> None:
    robot = make_description()
    traffic = NetworkTraffic()
    for tick in range(100):
        traffic.add(
            make_sample(
                "lab/worm/sensor/joints",
                make_joint_state(robot, tick=tick, timestamp_ns=tick * 10 * NS_PER_MS),
                10 * tick,
            )
        )
        traffic.add(make_sample("lab/worm/hal/clock", make_clock(tick + 2), 10 * tick + 1))
        command = make_joint_command(robot, tick=tick, sequence=tick)
        traffic.add(make_sample("lab/worm/actuator/joints", command, 10 * tick + 3))
    lines = {line.key: line for line in traffic.measure_keys(1000 * NS_PER_MS)}
    joints = lines[keys.JOINTS]
    assert joints.robot == "lab/worm"
    assert joints.writer == "HAL"
    assert joints.rate_hz == pytest.approx(100.0)
    assert joints.jitter_ms == pytest.approx(0.0, abs=1e-9)
    assert joints.received_ago_s == pytest.approx(0.01)
    assert joints.age_ms == pytest.approx(20.0)
    (latency,) = traffic.measure_latencies()
    assert latency.arrival_median_ms == pytest.approx(3.0)
    assert latency.arrival_p99_ms == pytest.approx(3.0)
    assert latency.count == 100


def test_topic_rate_with_many_unknown_keys_is_bounded() -> None:
    traffic = NetworkTraffic("worm")
    traffic.add(ReceivedSample("sensor/joints", b"noise", format_encoding(JointState), 0))
    for number in range(MAX_KEYS + 10):
        traffic.add(ReceivedSample(f"evil/{number}", b"x", "", number))
    for time_ms in range(2 * MAX_ARRIVAL_TIMES):
        traffic.add(ReceivedSample("evil/0", b"x", "", time_ms * NS_PER_MS))
    lines = traffic.measure_keys(NS_PER_MS)
    assert len(lines) == MAX_KEYS
    assert traffic.keys_left_out == 11
    assert lines[0].failure == "malformed"
    assert lines[1].writer is None
    text = "\n".join(TrafficSnapshot(lines, [], {}, {}, traffic.keys_left_out).format_table())
    assert "UNKNOWN" in text
    assert "11 messages on still more keys" in text


def test_topic_rate_as_json_measures_a_real_network() -> None:
    endpoint = find_free_endpoint()
    should_stop = threading.Event()
    lines: list[str] = []

    def publish_clock(session: Session) -> None:
        publisher = session.declare_publisher(keys.CLOCK, Clock)
        for tick in itertools.count():
            publisher.put(make_clock(tick))
            if should_stop.wait(0.02):
                return

    with open_session(ConnectionSettings(endpoint, "worm", listen=True)) as session:
        clock_thread = threading.Thread(target=publish_clock, args=(session,))
        clock_thread.start()
        try:
            exit_code = show_traffic(
                RobotSelection(endpoint), lines.append, once=True, as_json=True
            )
            assert exit_code == 0
        finally:
            should_stop.set()
            clock_thread.join()
    (line,) = json.loads(lines[0])["keys"]
    assert line["robot"] == "worm"
    assert line["key"] == "hal/clock"
    assert line["writer"] == "HAL"
    assert 10 < line["rate_hz"] < 60
