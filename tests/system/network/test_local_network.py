"""Sessions within one process do what those on a network do."""

from snakesim_hal.base.errors import NotConnectedError
from snakesim_hal.network.local_network import LocalNetwork
from snakesim_hal.network.streams import Query
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Answer, Done, LeaseRequest
from snakesim_testing.messages import raises_error

REQUEST = LeaseRequest(action="acquire", holder="control")


def test_local_network_delivers_matching_keys_and_latched_values_later() -> None:
    network = LocalNetwork()
    one, other = network.session(), network.session()
    every, reader = other.reader(keys.DONE_ALL, Done), other.reader(keys.done_key("control"), Done)
    publisher = one.latched_publisher(keys.done_key("control"), Done)
    assert publisher.has_subscriber()
    publisher.put(Done(tick=1))
    publisher.put(Done(tick=2))
    one.publisher(keys.done_key("guidance"), Done).put(Done(tick=3))
    assert [done.tick for done in reader.drain()] == [1, 2]
    assert [done.tick for done in every.drain()] == [1, 2, 3]
    assert other.latest(keys.done_key("control"), Done, 0.0) == Done(tick=2)
    other.close()
    assert not publisher.has_subscriber()


def test_tokens_come_and_go_with_their_session() -> None:
    network, seen = LocalNetwork(), list[tuple[str, bool]]()
    one, other = network.session(), network.session()
    one.declare_alive("control")
    other.on_alive(lambda key, present: seen.append((keys.parse_service(key), present)))
    one.close()
    assert seen == [("control", True), ("control", False)]


def test_who_is_asked_answers_before_the_question_returns() -> None:
    network, asked = LocalNetwork(), list[Query]()
    host, client = network.session(), network.session()
    host.on_query(keys.LEASE, asked.append)
    answer = Answer(ok=True, reason="", epoch=7, lifecycle="disarmed", host="a")

    def reply() -> None:
        for question in asked:
            question.reply(answer)

    network.answer = reply
    assert client.request(keys.LEASE, REQUEST, host="a").epoch == 7
    with raises_error(NotConnectedError, code="network/no-answer"):
        client.request(keys.LEASE, REQUEST, timeout_s=0.01, host="b")
    with raises_error(NotConnectedError, code="network/no-answer"):
        client.request(keys.ESTOP, REQUEST)
