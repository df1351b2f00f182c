"""At the end of a run in lockstep, the host stays until every recorder has received all its messages."""

import threading
from collections.abc import Callable

import pytest

from snakesim_hal.host import outbox
from snakesim_hal.network.streams import IncomingQuery
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Answer, ClockMode
from snakesim_testing.hal.local_network import running_host
from snakesim_testing.hal.small_robots import make_run_config

RECEIVED = Answer(ok=True, reason="all messages have arrived")
ANSWER_DELAY_S = 0.5

pytestmark = pytest.mark.usefixtures("quick_threads")


def end_host_beside_recorder(
    clock_mode: ClockMode, handle_request: Callable[[IncomingQuery], None]
) -> None:
    """Run a host without services, end it, and wait until it has ended.

    Args:
        clock_mode: Clock mode of the run.
        handle_request: Handles the request of the host to the recorder, in Zenoh's thread.
    """
    with running_host(make_run_config(clock_mode=clock_mode, services={})) as run:
        run.session.on_query(keys.RECEIVED, handle_request)
        run.host.request_stop()
        run.thread.join()


def test_host_in_lockstep_ends_only_after_answer_of_recorder() -> None:
    has_answered = threading.Event()

    def answer_later(query: IncomingQuery) -> None:
        def answer() -> None:
            has_answered.set()
            query.reply(RECEIVED)

        threading.Timer(ANSWER_DELAY_S, answer).start()

    end_host_beside_recorder("lockstep", answer_later)
    assert has_answered.is_set()


def test_host_waits_limited_time_for_recorder_that_never_answers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(outbox, "RECEIPT_TIMEOUT_S", 0.2)
    requests: list[IncomingQuery] = []
    end_host_beside_recorder("lockstep", requests.append)
    assert len(requests) == 1


def test_host_in_real_time_does_not_ask_recorder() -> None:
    requests: list[IncomingQuery] = []
    end_host_beside_recorder("realtime", requests.append)
    assert requests == []
