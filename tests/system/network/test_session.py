"""The Zenoh session over real loopback links: latched values, queries, liveliness, and separate namespaces."""

import os
import socket
import threading
import time
from pathlib import Path

import pytest
import zenoh

from snakesim_hal.base.errors import ConfigError, NotConnectedError
from snakesim_hal.network.router import open_router
from snakesim_hal.network.session import ConnectionSettings, open_session
from snakesim_hal.network.streams import IncomingQuery, Publisher, ReceivedSample
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import ENCODING_PREFIX, encode
from snakesim_hal.wire.messages import Answer, EstopRequest, JointState, LeaseRequest, TickDone
from snakesim_testing.hal.local_network import (
    connected_sessions,
    fast_thread_switching,
    wait_for_messages,
)
from snakesim_testing.hal.small_robots import make_description, make_joint_state
from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.messages import raises_error

ROBOT = make_description()


def test_session_latched_value_reaches_later_readers_once() -> None:
    endpoint = find_free_endpoint()
    with open_session(ConnectionSettings(endpoint, "worm", listen=True)) as hal:
        publisher = hal.declare_latched_publisher(keys.JOINTS, JointState)
        for tick in range(3):
            publisher.put(make_joint_state(ROBOT, tick=tick))
        with open_session(ConnectionSettings(endpoint, "worm")) as late:
            reader = late.declare_latched_reader(keys.JOINTS, JointState)
            arrivals: list[ReceivedSample] = []
            late.on_latched_arrival(keys.JOINTS, arrivals.append)
            latched = wait_for_messages(reader, "the latched value")
            wait_until(lambda: arrivals, "the latched arrival")
            assert [joints.tick for joints in latched] == [2]
            assert arrivals[0].key == keys.JOINTS
            publisher.put(make_joint_state(ROBOT, tick=3))
            assert [joints.tick for joints in wait_for_messages(reader, "the next value")] == [3]


def test_session_early_latched_reader_gets_value_when_publisher_joins() -> None:
    with connected_sessions("worm", "worm", "worm") as (_, early, hal):
        reader = early.declare_latched_reader(keys.JOINTS, JointState)
        hal.declare_latched_publisher(keys.JOINTS, JointState).put(make_joint_state(ROBOT, tick=7))
        assert wait_for_messages(reader, "the value")[0].tick == 7


def test_session_late_reader_gets_no_earlier_sample_of_stream() -> None:
    with connected_sessions("worm", "worm") as (hal, session):
        publisher = hal.declare_publisher(keys.JOINTS, JointState)
        publisher.put(make_joint_state(ROBOT, tick=1))
        reader = session.declare_reader(keys.JOINTS, JointState)
        wait_until(publisher.has_subscriber, "the subscription")
        publisher.put(make_joint_state(ROBOT, tick=2))
        assert [joints.tick for joints in wait_for_messages(reader, "the sample")] == [2]


def test_session_reader_keeps_newest_samples_and_counts_invalid_ones() -> None:
    with connected_sessions("worm", "worm") as (hal, session):
        reader = session.declare_reader(keys.JOINTS, JointState, depth=4)
        publisher = hal.declare_publisher(keys.JOINTS, JointState, lossless=True)
        wait_until(publisher.has_subscriber, "the subscription")
        end_arrivals: list[ReceivedSample] = []
        session.on_arrival(keys.done_key("end"), end_arrivals.append)
        end_publisher = hal.declare_publisher(keys.done_key("end"), TickDone, lossless=True)
        wait_until(end_publisher.has_subscriber, "the second subscription")
        for tick in range(20):
            publisher.put(make_joint_state(ROBOT, tick=tick))
        end_publisher.put(TickDone(tick=0))
        wait_until(lambda: end_arrivals, "the last sample")
        assert [joints.tick for joints in reader.drain()] == [16, 17, 18, 19]
        assert reader.drain() == []

        payload = encode(make_joint_state(ROBOT, tick=20))
        invalid_samples = [
            (payload, ENCODING_PREFIX + "JointState/2"),
            (payload, "zenoh/bytes"),
            (payload[:-3], ENCODING_PREFIX + "JointState/1"),
        ]
        valid_sample = (payload, ENCODING_PREFIX + "JointState/1")
        for payload, encoding in [*invalid_samples, valid_sample]:
            hal._zenoh.put(
                keys.JOINTS,
                payload,
                encoding=encoding,
                congestion_control=zenoh.CongestionControl.BLOCK,
            )
        assert [joints.tick for joints in wait_for_messages(reader, "the valid sample")] == [20]
        assert session.rejected == {"unknown_version": 1, "unknown_message": 1, "malformed": 1}


def test_session_that_receives_urgent_samples_can_be_closed() -> None:
    """Zenoh's own threads handle urgent samples, and may wait for the interpreter that closes the session."""
    endpoint = find_free_endpoint()
    stopped = threading.Event()

    def publish_until_stopped(publisher: Publisher[TickDone]) -> None:
        while not stopped.is_set():
            publisher.put(TickDone(tick=0))

    with open_session(ConnectionSettings(endpoint, "a", listen=True)) as hal:
        publisher = hal.declare_publisher(keys.done_key("one"), TickDone)
        publishing = threading.Thread(target=publish_until_stopped, args=(publisher,), daemon=True)
        publishing.start()
        for _ in range(5):
            arrivals: list[ReceivedSample] = []
            with open_session(ConnectionSettings(endpoint, "a")) as session:
                session.on_urgent_arrival(keys.DONE_ALL, arrivals.append)
                wait_until(lambda arrivals=arrivals: len(arrivals) > 100, "samples")
        stopped.set()
        publishing.join()


def test_session_namespaces_are_separate_except_for_a_tool() -> None:
    with connected_sessions("lab/a", "lab/b", None) as (a, b, tool):
        arrivals_a: list[ReceivedSample] = []
        arrivals_b: list[ReceivedSample] = []
        tool_arrivals: list[ReceivedSample] = []
        a.on_arrival(keys.DONE_ALL, arrivals_a.append)
        b.on_arrival(keys.DONE_ALL, arrivals_b.append)
        tool.on_arrival(f"**/{keys.DONE_ALL}", tool_arrivals.append)
        publishers = [
            a.declare_publisher(keys.done_key("a"), TickDone),
            b.declare_publisher(keys.done_key("b"), TickDone),
        ]

        def put_and_check_arrivals() -> bool:
            for publisher in publishers:
                publisher.put(TickDone(tick=1))
            tool_keys = {arrival.key for arrival in tool_arrivals}
            return len(tool_keys) == 2 and bool(arrivals_a and arrivals_b)

        # Samples are put again until every subscription is connected.
        wait_until(put_and_check_arrivals, "a sample in every session")
        assert {arrival.key for arrival in arrivals_a} == {"hal/done/a"}
        assert {arrival.key for arrival in arrivals_b} == {"hal/done/b"}
        split_keys = {keys.split_namespace(arrival.key) for arrival in tool_arrivals}
        assert split_keys == {("lab/a", "hal/done/a"), ("lab/b", "hal/done/b")}


def test_session_query_by_pattern_is_answered_with_declared_key() -> None:
    queries: list[IncomingQuery] = []
    with connected_sessions("worm", None) as (hal, tool):
        hal.on_query(keys.ESTOP, queries.append)
        for pattern in ("**", "worm/hal/*"):
            replies = tool._zenoh.get(pattern, timeout=5.0)
            wait_until(lambda: queries, "the query")
            assert queries[0].key == keys.ESTOP
            assert queries[0].payload == b""
            queries.pop().reply(Answer(ok=True, reason=""))
            (reply,) = replies
            assert reply.ok is not None
            assert str(reply.ok.key_expr) == "worm/hal/estop"


def test_session_answer_to_disconnected_client_raises_no_error() -> None:
    endpoint = find_free_endpoint()
    queries: list[IncomingQuery] = []
    with open_session(ConnectionSettings(endpoint, "worm", listen=True)) as hal:
        hal.on_query(keys.ESTOP, queries.append)
        with (
            open_session(ConnectionSettings(endpoint, "worm")) as session,
            pytest.raises(NotConnectedError),
        ):
            session.send_request(keys.ESTOP, EstopRequest(requester="a person"), timeout_s=0.1)
        wait_until(lambda: queries, "the query")
        queries[0].reply(Answer(ok=True, reason=""))


def test_session_without_peer_or_responder_raises_error_soon() -> None:
    endpoint = find_free_endpoint()
    start_s = time.monotonic()
    with (
        raises_error(NotConnectedError, code="network/nothing-listens"),
        open_session(ConnectionSettings(endpoint, "worm"), connect_timeout_s=0.2),
    ):
        pass
    with (
        open_session(ConnectionSettings(endpoint, "worm", listen=True)),
        open_session(ConnectionSettings(endpoint, "worm")) as session,
        raises_error(NotConnectedError, code="network/no-answer"),
    ):
        session.send_request(
            keys.LEASE, LeaseRequest(action="acquire", holder="control"), timeout_s=0.2
        )
    assert time.monotonic() - start_s < 5.0
    with pytest.raises(ConnectionError):
        raise NotConnectedError("callers may also catch the built-in class")


def test_session_listening_on_used_port_raises_port_in_use() -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        endpoint = f"tcp/127.0.0.1:{other.getsockname()[1]}"
        with (
            raises_error(NotConnectedError, code="network/port-in-use", field="--endpoint"),
            open_session(ConnectionSettings(endpoint, "worm", listen=True)),
        ):
            pass


def test_session_liveliness_reports_present_new_and_lost_services() -> None:
    endpoint = find_free_endpoint()
    changes: list[tuple[str, bool]] = []
    with open_session(ConnectionSettings(endpoint, "worm", listen=True)) as hal:
        with open_session(ConnectionSettings(endpoint, "worm")) as first:
            first.declare_alive("guidance")
            with open_session(ConnectionSettings(endpoint, "worm")) as second:
                second.declare_alive("control")
                hal.on_token_change(
                    lambda key, present: changes.append((keys.parse_service(key), present))
                )
                wait_until(lambda: len(changes) >= 2, "both tokens")
                assert set(changes) == {("guidance", True), ("control", True)}
            wait_until(lambda: ("control", False) in changes, "control is gone")
            assert ("guidance", False) not in changes
        wait_until(lambda: ("guidance", False) in changes, "guidance is gone")


def test_router_requires_file_with_router_mode_and_safe_endpoint(tmp_path: Path) -> None:
    path = tmp_path / "router.json5"
    for text in ('{mode: "client"}', "{mode: "):
        path.write_text(text)
        with raises_error(ConfigError, code="network/session-file"), open_router(path):
            pass
    path.write_text('{mode: "router"}')  # Zenoh's default is every interface
    with raises_error(ConfigError, code="network/insecure-endpoint"), open_router(path):
        pass
    endpoint = find_free_endpoint()
    path.write_text(
        f'{{mode: "router", listen: {{endpoints: ["{endpoint}"]}}, scouting: {{multicast: {{enabled: false}}}}}}'
    )
    with (
        open_router(path),
        open_session(ConnectionSettings(endpoint, "a")) as sender,
        open_session(ConnectionSettings(endpoint, "a")) as receiver,
    ):
        arrivals: list[ReceivedSample] = []
        receiver.on_arrival(keys.DONE_ALL, arrivals.append)
        publisher = sender.declare_publisher(keys.done_key("x"), TickDone)
        wait_until(publisher.has_subscriber, "the subscription")
        publisher.put(TickDone(tick=1))
        wait_until(lambda: arrivals, "the sample through the router")


def test_session_opened_by_several_threads_keeps_environment_unchanged() -> None:
    endpoint = find_free_endpoint()
    environment_before = dict(os.environ)
    errors: list[BaseException] = []

    def open_sessions(start: threading.Barrier) -> None:
        try:
            for _ in range(20):
                start.wait(20.0)
                with open_session(ConnectionSettings(endpoint, "worm")):
                    pass
        except BaseException as error:  # noqa: BLE001 - the main thread checks the errors
            errors.append(error)
            start.abort()

    with (
        fast_thread_switching(1e-6),
        open_session(ConnectionSettings(endpoint, "worm", listen=True)),
    ):
        start = threading.Barrier(8)
        threads = [threading.Thread(target=open_sessions, args=(start,)) for _ in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert not errors
    assert dict(os.environ) == environment_before
