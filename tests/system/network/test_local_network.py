"""The sessions of one process behave as sessions on a network, and share the messages that they decode."""

import math
from unittest import mock

from snakesim_hal.base.errors import NotConnectedError
from snakesim_hal.host.inbox import HostInbox
from snakesim_hal.network.local_network import LocalNetwork, LocalSession
from snakesim_hal.network.streams import IncomingQuery
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import encode
from snakesim_hal.wire.messages import Answer, JointCommand, LeaseRequest, TickDone
from snakesim_hal.wire.outgoing import encode_checked
from snakesim_testing.hal.small_robots import make_description, make_joint_command
from snakesim_testing.messages import raises_error

REQUEST = LeaseRequest(action="acquire", holder="control")


def create_sessions(network: LocalNetwork, count: int) -> list[LocalSession]:
    """Create sessions of one network."""
    return [network.create_session() for _ in range(count)]


def test_local_network_delivers_matching_keys_and_latched_values_later() -> None:
    network = LocalNetwork()
    sender, receiver = create_sessions(network, 2)
    reader_of_all = receiver.declare_reader(keys.DONE_ALL, TickDone)
    reader = receiver.declare_reader(keys.done_key("control"), TickDone)
    publisher = sender.declare_latched_publisher(keys.done_key("control"), TickDone)
    assert publisher.has_subscriber()
    publisher.put(TickDone(tick=1))
    publisher.put(TickDone(tick=2))
    sender.declare_publisher(keys.done_key("guidance"), TickDone).put(TickDone(tick=3))
    assert [done.tick for done in reader.drain()] == [1, 2]
    assert [done.tick for done in reader_of_all.drain()] == [1, 2, 3]
    assert receiver.wait_for_latched(keys.done_key("control"), TickDone, 0.0) == TickDone(tick=2)
    receiver.close()
    assert not publisher.has_subscriber()


def test_local_network_token_disappears_with_its_session() -> None:
    network = LocalNetwork()
    service, observer = create_sessions(network, 2)
    changes: list[tuple[str, bool]] = []
    service.declare_alive("control")
    observer.on_token_change(
        lambda key, present: changes.append((keys.parse_service(key), present))
    )
    service.close()
    assert changes == [("control", True), ("control", False)]


def test_local_network_query_is_answered_before_it_returns() -> None:
    network = LocalNetwork()
    host, client = create_sessions(network, 2)
    queries: list[IncomingQuery] = []
    host.on_query(keys.LEASE, queries.append)
    answer = Answer(ok=True, reason="", epoch=7, lifecycle="disarmed", host="a")

    def reply_to_queries() -> None:
        for query in queries:
            query.reply(answer)

    network.run_responders = reply_to_queries
    assert client.send_request(keys.LEASE, REQUEST, host="a").epoch == 7
    with raises_error(NotConnectedError, code="network/no-answer"):
        client.send_request(keys.LEASE, REQUEST, timeout_s=0.01, host="b")
    with raises_error(NotConnectedError, code="network/no-answer"):
        client.send_request(keys.ESTOP, REQUEST)


def test_local_readers_share_message_decoded_by_first_reader() -> None:
    sender, first, second = create_sessions(LocalNetwork(), 3)
    key = keys.done_key("control")
    first_reader = first.declare_reader(key, TickDone)
    second_reader = second.declare_reader(key, TickDone)
    sent = TickDone(tick=4)
    sender.declare_publisher(key, TickDone).put(sent)
    (first_message,) = first_reader.drain()
    (second_message,) = second_reader.drain()
    assert first_message is second_message
    assert first_message == sent
    assert first_message is not sent  # the sender's own object never reaches a reader


def test_local_readers_share_message_decoded_by_check_of_sender() -> None:
    sender, first, second = create_sessions(LocalNetwork(), 3)
    key = keys.done_key("control")
    first_reader = first.declare_reader(key, TickDone)
    second_reader = second.declare_reader(key, TickDone)
    reader_of_wrong_type = second.declare_reader(key, Answer)
    encoded = encode_checked(key, TickDone(tick=4))
    sender.declare_publisher(key, TickDone).put(TickDone(tick=4), encoded)
    assert first_reader.drain()[0] is encoded.decoded
    assert second_reader.drain()[0] is encoded.decoded
    assert reader_of_wrong_type.drain() == []
    assert second.rejected == {"unknown_message": 1}


def test_local_reader_decodes_message_that_a_fault_changed() -> None:
    sender, receiver = create_sessions(LocalNetwork(), 2)
    key = keys.done_key("control")
    reader = receiver.declare_reader(key, TickDone)
    publisher = sender.declare_publisher(key, TickDone)
    sender.reroute(key, lambda _payload: sender.send(key, encode(TickDone(tick=5))))
    publisher.put(TickDone(tick=4), encode_checked(key, TickDone(tick=4)))
    assert reader.drain() == [TickDone(tick=5)]
    sender.reroute(key, None)
    publisher.put(TickDone(tick=6), encode_checked(key, TickDone(tick=6)))
    assert reader.drain() == [TickDone(tick=6)]


def test_local_readers_of_malformed_message_each_reject_it() -> None:
    sender, first, second = create_sessions(LocalNetwork(), 3)
    key = keys.done_key("control")
    readers = [
        first.declare_reader(key, TickDone),
        second.declare_reader(key, TickDone),
        second.declare_reader(key, Answer),
    ]
    publisher = sender.declare_publisher(key, TickDone)
    publisher.send(encode(TickDone(tick=-4)))
    assert [reader.drain() for reader in readers] == [[], [], []]
    assert first.rejected == {"malformed": 1}
    assert second.rejected == {"malformed": 1, "unknown_message": 1}


def test_local_host_shares_no_command_object_with_readers() -> None:
    sender, observer, host = create_sessions(LocalNetwork(), 3)
    reader = observer.declare_reader(keys.JOINT_COMMAND, JointCommand)
    receiver = mock.Mock()
    inbox = HostInbox(host, receiver, [], lambda _query, _answer: None)
    command = make_joint_command(make_description(), 0.1)
    encoded = encode_checked(keys.JOINT_COMMAND, command)
    sender.declare_publisher(keys.JOINT_COMMAND, JointCommand).put(command, encoded)
    (read_command,) = reader.drain()
    read_command.target[0] = 3.0  # as a careless service might do
    inbox.handle_queued(math.inf)
    received_command = receiver.on_command.call_args.args[0]
    assert set(received_command.target) == {0.1}
