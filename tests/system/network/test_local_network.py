"""Sessions within one process do what those on a network do."""

import math
from unittest import mock

from snakesim_hal.base.errors import NotConnectedError
from snakesim_hal.host.inbox import HostInbox
from snakesim_hal.network.local_network import LocalNetwork
from snakesim_hal.network.streams import IncomingQuery
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import encode
from snakesim_hal.wire.messages import Answer, JointCommand, LeaseRequest, TickDone
from snakesim_hal.wire.outgoing import encode_checked
from snakesim_testing.hal.small_robots import make_description, make_joint_command
from snakesim_testing.messages import raises_error

REQUEST = LeaseRequest(action="acquire", holder="control")


def test_local_network_delivers_matching_keys_and_latched_values_later() -> None:
    network = LocalNetwork()
    one, other = network.create_session(), network.create_session()
    every, reader = (
        other.declare_reader(keys.DONE_ALL, TickDone),
        other.declare_reader(keys.done_key("control"), TickDone),
    )
    publisher = one.declare_latched_publisher(keys.done_key("control"), TickDone)
    assert publisher.has_subscriber()
    publisher.put(TickDone(tick=1))
    publisher.put(TickDone(tick=2))
    one.declare_publisher(keys.done_key("guidance"), TickDone).put(TickDone(tick=3))
    assert [done.tick for done in reader.drain()] == [1, 2]
    assert [done.tick for done in every.drain()] == [1, 2, 3]
    assert other.wait_for_latched(keys.done_key("control"), TickDone, 0.0) == TickDone(tick=2)
    other.close()
    assert not publisher.has_subscriber()


def test_tokens_come_and_go_with_their_session() -> None:
    network, seen = LocalNetwork(), list[tuple[str, bool]]()
    one, other = network.create_session(), network.create_session()
    one.declare_alive("control")
    other.on_token_change(lambda key, present: seen.append((keys.parse_service(key), present)))
    one.close()
    assert seen == [("control", True), ("control", False)]


def test_who_is_asked_answers_before_the_question_returns() -> None:
    network, asked = LocalNetwork(), list[IncomingQuery]()
    host, client = network.create_session(), network.create_session()
    host.on_query(keys.LEASE, asked.append)
    answer = Answer(ok=True, reason="", epoch=7, lifecycle="disarmed", host="a")

    def reply() -> None:
        for question in asked:
            question.reply(answer)

    network.run_responders = reply
    assert client.send_request(keys.LEASE, REQUEST, host="a").epoch == 7
    with raises_error(NotConnectedError, code="network/no-answer"):
        client.send_request(keys.LEASE, REQUEST, timeout_s=0.01, host="b")
    with raises_error(NotConnectedError, code="network/no-answer"):
        client.send_request(keys.ESTOP, REQUEST)


def test_readers_of_one_process_share_the_message_that_the_first_has_decoded() -> None:
    network = LocalNetwork()
    sender, one, other = (
        network.create_session(),
        network.create_session(),
        network.create_session(),
    )
    readers = [
        session.declare_reader(keys.done_key("control"), TickDone) for session in (one, other)
    ]
    sent = TickDone(tick=4)
    sender.declare_publisher(keys.done_key("control"), TickDone).put(sent)
    (first,), (second,) = (reader.drain() for reader in readers)
    assert first is second
    assert first == sent
    assert first is not sent  # the sender's own message is encoded, and never handed to a reader


def test_readers_of_one_process_share_the_message_that_the_check_of_the_sender_has_decoded() -> (
    None
):
    network = LocalNetwork()
    sender, one, other = (
        network.create_session(),
        network.create_session(),
        network.create_session(),
    )
    key = keys.done_key("control")
    readers = [
        one.declare_reader(key, TickDone),
        other.declare_reader(key, TickDone),
        other.declare_reader(key, Answer),
    ]
    encoded = encode_checked(key, TickDone(tick=4))
    sender.declare_publisher(key, TickDone).put(TickDone(tick=4), encoded)
    first, second, of_wrong_type = (reader.drain() for reader in readers)
    assert first[0] is encoded.decoded
    assert second[0] is encoded.decoded
    assert of_wrong_type == []
    assert other.rejected == {"unknown_message": 1}


def test_reader_decodes_the_bytes_of_a_message_that_a_fault_has_changed() -> None:
    network = LocalNetwork()
    sender, reading = network.create_session(), network.create_session()
    key = keys.done_key("control")
    reader = reading.declare_reader(key, TickDone)
    publisher = sender.declare_publisher(key, TickDone)
    sender.reroute(key, lambda _payload: sender.send(key, encode(TickDone(tick=5))))
    publisher.put(TickDone(tick=4), encode_checked(key, TickDone(tick=4)))
    assert reader.drain() == [TickDone(tick=5)]
    sender.reroute(key, None)
    publisher.put(TickDone(tick=6), encode_checked(key, TickDone(tick=6)))
    assert reader.drain() == [TickDone(tick=6)]


def test_each_reader_checks_what_no_reader_could_decode() -> None:
    network = LocalNetwork()
    sender, one, other = (
        network.create_session(),
        network.create_session(),
        network.create_session(),
    )
    key = keys.done_key("control")
    readers = [
        one.declare_reader(key, TickDone),
        other.declare_reader(key, TickDone),
        other.declare_reader(key, Answer),
    ]
    publisher = sender.declare_publisher(key, TickDone)
    publisher.send(encode(TickDone(tick=-4)))
    assert [reader.drain() for reader in readers] == [[], [], []]
    assert one.rejected == {"malformed": 1}
    assert other.rejected == {"malformed": 1, "unknown_message": 1}


def test_host_shares_no_command_with_the_readers_of_its_process() -> None:
    network = LocalNetwork()
    sender, reading, host = (
        network.create_session(),
        network.create_session(),
        network.create_session(),
    )
    reader = reading.declare_reader(keys.JOINT_COMMAND, JointCommand)
    receiver = mock.Mock()
    inbox = HostInbox(host, receiver, [], lambda _query, _answer: None)
    command = make_joint_command(make_description(), 0.1)
    encoded = encode_checked(keys.JOINT_COMMAND, command)
    sender.declare_publisher(keys.JOINT_COMMAND, JointCommand).put(command, encoded)
    (read,) = reader.drain()
    read.target[0] = 3.0  # as a careless service might
    inbox.handle_queued(math.inf)
    received = receiver.on_command.call_args.args[0]
    assert set(received.target) == {0.1}
