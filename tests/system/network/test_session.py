"""The Zenoh session over real loopback links: latched values, queries, liveliness, and robots kept apart."""

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
            reader, arrived = (
                late.declare_latched_reader(keys.JOINTS, JointState),
                list[ReceivedSample](),
            )
            late.on_latched_arrival(keys.JOINTS, arrived.append)
            found = wait_for_messages(reader, "the latched value")
            wait_until(lambda: arrived, "the latched arrival")
            assert [joints.tick for joints in found] == [2]
            assert arrived[0].key == keys.JOINTS
            publisher.put(make_joint_state(ROBOT, tick=3))
            assert [joints.tick for joints in wait_for_messages(reader, "the next value")] == [3]


def test_session_early_reader_gets_value_when_publisher_joins() -> None:
    with connected_sessions("worm", "worm", "worm") as (_, early, hal):
        reader = early.declare_latched_reader(keys.JOINTS, JointState)
        hal.declare_latched_publisher(keys.JOINTS, JointState).put(make_joint_state(ROBOT, tick=7))
        assert wait_for_messages(reader, "the value")[0].tick == 7


def test_a_stream_is_not_given_to_those_who_come_late() -> None:
    with connected_sessions("worm", "worm") as (hal, session):
        publisher = hal.declare_publisher(keys.JOINTS, JointState)
        publisher.put(make_joint_state(ROBOT, tick=1))
        reader = session.declare_reader(keys.JOINTS, JointState)
        wait_until(publisher.has_subscriber, "the subscription")
        publisher.put(make_joint_state(ROBOT, tick=2))
        assert [joints.tick for joints in wait_for_messages(reader, "the sample")] == [2]


def test_session_reader_keeps_newest_and_counts_dropped_samples() -> None:
    with connected_sessions("worm", "worm") as (hal, session):
        reader = session.declare_reader(keys.JOINTS, JointState, depth=4)
        publisher = hal.declare_publisher(keys.JOINTS, JointState, lossless=True)
        wait_until(publisher.has_subscriber, "the subscription")
        arrived: list[ReceivedSample] = []
        session.on_arrival(keys.done_key("end"), arrived.append)
        end = hal.declare_publisher(keys.done_key("end"), TickDone, lossless=True)
        wait_until(end.has_subscriber, "the second subscription")
        for tick in range(20):
            publisher.put(make_joint_state(ROBOT, tick=tick))
        end.put(TickDone(tick=0))
        wait_until(lambda: arrived, "the last sample")
        assert [joints.tick for joints in reader.drain()] == [16, 17, 18, 19]
        assert reader.drain() == []
        good = encode(make_joint_state(ROBOT, tick=20))
        bad = [
            (good, ENCODING_PREFIX + "JointState/2"),
            (good, "zenoh/bytes"),
            (good[:-3], ENCODING_PREFIX + "JointState/1"),
        ]
        for payload, encoding in [*bad, (good, ENCODING_PREFIX + "JointState/1")]:
            hal._zenoh.put(
                keys.JOINTS,
                payload,
                encoding=encoding,
                congestion_control=zenoh.CongestionControl.BLOCK,
            )
        assert [joints.tick for joints in wait_for_messages(reader, "the good one")] == [20]
        assert session.rejected == {"unknown_version": 1, "unknown_message": 1, "malformed": 1}


def test_a_session_closes_while_urgent_samples_arrive() -> None:
    """They are taken in Zenoh's own threads, which wait for the interpreter that closes the session."""
    endpoint, stopped = find_free_endpoint(), threading.Event()

    def talk(publisher: Publisher[TickDone]) -> None:
        while not stopped.is_set():
            publisher.put(TickDone(tick=0))

    with open_session(ConnectionSettings(endpoint, "a", listen=True)) as hal:
        talker = threading.Thread(
            target=talk, args=(hal.declare_publisher(keys.done_key("one"), TickDone),), daemon=True
        )
        talker.start()
        for _ in range(5):
            arrived: list[ReceivedSample] = []
            with open_session(ConnectionSettings(endpoint, "a")) as session:
                session.on_urgent_arrival(keys.DONE_ALL, arrived.append)
                wait_until(lambda arrived=arrived: len(arrived) > 100, "samples")
        stopped.set()
        talker.join()


def test_session_namespaces_are_separate_except_for_a_tool() -> None:
    with connected_sessions("lab/a", "lab/b", None) as (a, b, tool):
        heard: dict[str, list[ReceivedSample]] = {"a": [], "b": [], "tool": []}
        a.on_arrival(keys.DONE_ALL, heard["a"].append)
        b.on_arrival(keys.DONE_ALL, heard["b"].append)
        tool.on_arrival(f"**/{keys.DONE_ALL}", heard["tool"].append)
        publishers = [
            session.declare_publisher(keys.done_key(name), TickDone)
            for session, name in ((a, "a"), (b, "b"))
        ]

        def heard_everywhere() -> bool:
            for publisher in publishers:
                publisher.put(TickDone(tick=1))
            return len({arrival.key for arrival in heard["tool"]}) == 2 and bool(
                heard["a"] and heard["b"]
            )

        # Put again until every subscription has been made.
        wait_until(heard_everywhere, "everybody's sample")
        assert {arrival.key for arrival in heard["a"]} == {"hal/done/a"}
        assert {arrival.key for arrival in heard["b"]} == {"hal/done/b"}
        split = {keys.split_namespace(arrival.key) for arrival in heard["tool"]}
        assert split == {("lab/a", "hal/done/a"), ("lab/b", "hal/done/b")}


def test_session_query_by_pattern_concerns_the_declared_key() -> None:
    questions: list[IncomingQuery] = []
    with connected_sessions("worm", None) as (hal, tool):
        hal.on_query(keys.ESTOP, questions.append)
        for pattern in ("**", "worm/hal/*"):
            replies = tool._zenoh.get(pattern, timeout=5.0)
            wait_until(lambda: questions, "the question")
            assert questions[0].key == keys.ESTOP
            assert questions[0].payload == b""
            questions.pop().reply(Answer(ok=True, reason=""))
            (reply,) = replies
            assert reply.ok is not None
            assert str(reply.ok.key_expr) == "worm/hal/estop"


def test_an_answer_to_somebody_who_has_gone_hurts_nobody() -> None:
    endpoint = find_free_endpoint()
    questions: list[IncomingQuery] = []
    with open_session(ConnectionSettings(endpoint, "worm", listen=True)) as hal:
        hal.on_query(keys.ESTOP, questions.append)
        with (
            open_session(ConnectionSettings(endpoint, "worm")) as session,
            pytest.raises(NotConnectedError),
        ):
            session.send_request(keys.ESTOP, EstopRequest(requester="a person"), timeout_s=0.1)
        wait_until(lambda: questions, "the question")
        questions[0].reply(Answer(ok=True, reason=""))


def test_nobody_there_is_told_soon() -> None:
    endpoint = find_free_endpoint()
    began = time.monotonic()
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
    assert time.monotonic() - began < 5.0
    with pytest.raises(ConnectionError):
        raise NotConnectedError("it is the matching builtin, too")


def test_a_port_that_is_taken_is_named() -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        endpoint = f"tcp/127.0.0.1:{other.getsockname()[1]}"
        with (
            raises_error(NotConnectedError, code="network/port-in-use", field="--endpoint"),
            open_session(ConnectionSettings(endpoint, "worm", listen=True)),
        ):
            pass


def test_liveliness_shows_who_comes_who_was_there_and_who_goes() -> None:
    endpoint = find_free_endpoint()
    seen: list[tuple[str, bool]] = []
    with open_session(ConnectionSettings(endpoint, "worm", listen=True)) as hal:
        with open_session(ConnectionSettings(endpoint, "worm")) as first:
            first.declare_alive("guidance")
            with open_session(ConnectionSettings(endpoint, "worm")) as second:
                second.declare_alive("control")
                hal.on_token_change(
                    lambda key, present: seen.append((keys.parse_service(key), present))
                )
                wait_until(lambda: len(seen) >= 2, "both tokens")
                assert set(seen) == {("guidance", True), ("control", True)}
            wait_until(lambda: ("control", False) in seen, "control's going")
            assert ("guidance", False) not in seen
        wait_until(lambda: ("guidance", False) in seen, "guidance's going")


def test_a_router_wants_a_file_that_says_so(tmp_path: Path) -> None:
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
        open_session(ConnectionSettings(endpoint, "a")) as one,
        open_session(ConnectionSettings(endpoint, "a")) as two,
    ):
        arrived: list[ReceivedSample] = []
        two.on_arrival(keys.DONE_ALL, arrived.append)
        publisher = one.declare_publisher(keys.done_key("x"), TickDone)
        wait_until(publisher.has_subscriber, "the subscription")
        publisher.put(TickDone(tick=1))
        wait_until(lambda: arrived, "the sample through the router")


def test_session_may_be_opened_by_threads_without_changing_environment() -> None:
    endpoint, before, failed = find_free_endpoint(), dict(os.environ), list[BaseException]()

    def open_often(start: threading.Barrier) -> None:
        try:
            for _ in range(20):
                start.wait(20.0)
                with open_session(ConnectionSettings(endpoint, "worm")):
                    pass
        except BaseException as error:  # noqa: BLE001 - shown below
            failed.append(error)
            start.abort()

    with (
        fast_thread_switching(1e-6),
        open_session(ConnectionSettings(endpoint, "worm", listen=True)),
    ):
        together = threading.Barrier(8)
        threads = [threading.Thread(target=open_often, args=(together,)) for _ in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert not failed and dict(os.environ) == before, failed
