"""C5, C7, C8 and C10: floods of a console do not prevent the stops of its page.

A page has two stops: its button, and a second stop by plain HTTP (`POST /stop`), which works without the process that
serves the pages.
"""

import http.client
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from typing import Any
from urllib.parse import urlsplit

import pytest

from snakesim_testing.harness.page import (
    CAMERA,
    STOP,
    ViewerPage,
    flood,
    origin_of,
    send_http_request,
)
from verification.attack.command import parse_endpoint
from verification.attack.console import (
    READY_ANSWER,
    STOP_TIMEOUT_S,
    find_page_server,
    measure_page_server_memory,
    measure_stop_time,
    wait_for_second_stop,
)
from verification.attack.effort import RecordProperty, choose_effort
from verification.attack.robot import AttackedRobot
from verification.attack.tools.floods import hold_half_sent_requests
from verification.attack.tools.processes import freeze_process

FLOOD_DURATION_S = float(choose_effort(2, 20))
MAX_FLOODED_STOP_S = 5.0  # the promised limit during a flood; a stop takes about 0.02 s
MAX_FLOOD_MEMORY_MB = 80.0  # that a flood may add to the console
# Together far more than the console may open files (`MAX_OPEN_FILES` in features/console/command.py).
HALF_REQUESTS_PER_PROCESS = 2000
HALF_REQUEST_PROCESSES = 3

HttpAnswer = tuple[int, str]


def post_stop(console_address: str) -> HttpAnswer:
    """Use the second stop as a page does, over a new connection."""
    return send_http_request(console_address, "POST", Origin=origin_of(console_address))


def assert_confirms_stop(answer: HttpAnswer) -> None:
    """Fail unless the answer of the second stop confirms it."""
    status, text = answer
    assert status == 200, answer
    assert "planar13: stopped" in text, answer


@contextmanager
def flood_with_messages(console_address: str, message: Any) -> Iterator[None]:
    """Send a message from several viewers as fast as they can; wait for them at the end."""
    with ExitStack() as stack:
        for _ in range(choose_effort(3, 12)):
            thread = threading.Thread(
                target=flood, args=(console_address, message, FLOOD_DURATION_S + 2.0)
            )
            thread.start()
            stack.callback(thread.join)
        yield


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["camera", "unknown", "stop"])
def test_c5_no_flood_of_messages_prevents_the_stop(
    robot_with_console: AttackedRobot,
    console_address: str,
    kind: str,
    record_property: RecordProperty,
) -> None:
    health = robot_with_console.record_health()
    with ViewerPage(console_address) as other:
        button = other.find(STOP)
        message = {
            "camera": CAMERA,
            "unknown": {"type": "GuiUpdateMessage", "uuid": button, "updates": {"update_cb": []}},
            "stop": {"type": "GuiUpdateMessage", "uuid": button, "updates": {"value": True}},
        }[kind]
        memory_before_mb = measure_page_server_memory(robot_with_console)
        with flood_with_messages(console_address, message):
            if kind == "stop":
                # The flood itself stops the robot.
                since_s = time.monotonic() - 1.0
                robot_with_console.operator.wait_for_emergency_stop(since_s, STOP_TIMEOUT_S)
            else:
                time.sleep(FLOOD_DURATION_S)
                stop_s = measure_stop_time(robot_with_console, lambda: other.click(STOP))
                record_property("stopped after", f"{stop_s:.2f} s from a click")
            start_s = time.monotonic()
            assert send_http_request(console_address, "GET") == READY_ANSWER
            answer_ms = 1000 * (time.monotonic() - start_s)
            record_property("second stop answers", f"{answer_ms:.0f} ms")
    memory_mb = measure_page_server_memory(robot_with_console)
    assert memory_mb < memory_before_mb + MAX_FLOOD_MEMORY_MB
    robot_with_console.assert_unharmed(health, kind)


def test_c7_the_second_stop_needs_nothing_of_the_page(
    robot_with_console: AttackedRobot, console_address: str, record_property: RecordProperty
) -> None:
    health = robot_with_console.record_health()
    console = parse_endpoint(origin_of(console_address).replace("http://", "tcp/"))
    half_requests = (b"", b"POST /stop HTTP/1.1\r\nHost: ", b"GET / HTTP/1.1\r\n")
    with ExitStack() as connections:
        for half_request in half_requests * choose_effort(40, 100):
            connection = connections.enter_context(socket.create_connection(console))
            connection.sendall(half_request)
        answers: list[HttpAnswer] = []
        stop_s = measure_stop_time(
            robot_with_console, lambda: answers.append(post_stop(console_address))
        )
        assert_confirms_stop(answers[0])
    record_property("stopped after", f"{1000 * stop_s:.0f} ms from POST /stop")
    status, page = send_http_request(console_address, "GET", "/")
    assert status == 200
    assert 'id = "second-stop"' in page
    robot_with_console.assert_unharmed(health)


def hold_more_requests_than_files(console_address: str) -> Any:
    """Keep more half-sent requests open than each process of the console may open files."""
    return hold_half_sent_requests(
        console_address, HALF_REQUESTS_PER_PROCESS, HALF_REQUEST_PROCESSES
    )


def test_c8_half_sent_requests_do_not_block_the_stop(
    robot_with_console: AttackedRobot, console_address: str, record_property: RecordProperty
) -> None:
    """All stops work during and after more half-sent requests than the console may open files."""
    robot = robot_with_console
    health = robot.record_health()
    with (
        ViewerPage(console_address) as page,
        ViewerPage(console_address, draws=False) as page_without_webgl,
    ):
        stops: dict[str, Callable[[], object]] = {
            "the page's button": lambda: page.click(STOP),
            "the button of a page without WebGL": lambda: page_without_webgl.click(STOP),
            "POST /stop": lambda: post_stop(console_address),
        }
        page.find(STOP)
        page_without_webgl.find(STOP)
        with hold_more_requests_than_files(console_address):
            for name, stop in stops.items():
                stop_s = measure_stop_time(robot, stop)
                record_property(f"stopped in the flood by {name}", f"after {1000 * stop_s:.0f} ms")
                assert stop_s < MAX_FLOODED_STOP_S, name
                robot.operator.recover_robot()
            wait_for_second_stop(console_address)
        for name, stop in stops.items():
            assert measure_stop_time(robot, stop) < MAX_FLOODED_STOP_S, name
            robot.operator.recover_robot()
        with ViewerPage(console_address) as later_page:
            later_page.find(STOP)
    robot.assert_unharmed(health)


@contextmanager
def open_kept_connection(console_address: str) -> Iterator[Callable[[str], HttpAnswer]]:
    """Open a connection that is used for several requests of the second stop, as a page does.

    Yields:
        A function that sends a request with an HTTP method, and returns status and text of the answer.
    """
    parts = urlsplit(console_address)
    headers = {"Origin": origin_of(console_address)}
    with closing(http.client.HTTPConnection(parts.netloc, timeout=20.0)) as connection:

        def send_request(method: str) -> HttpAnswer:
            connection.request(method, f"{parts.path}stop", headers=headers)
            answer = connection.getresponse()
            return answer.status, answer.read().decode()

        yield send_request


def test_c10_second_stop_works_while_the_page_server_is_frozen(
    robot_with_console: AttackedRobot, console_address: str, record_property: RecordProperty
) -> None:
    robot = robot_with_console
    health = robot.record_health()
    page_server = find_page_server(robot)
    wait_for_second_stop(console_address)
    with freeze_process(page_server), open_kept_connection(console_address) as send_request:
        assert send_request("GET") == READY_ANSWER
        stops: dict[str, Callable[[], HttpAnswer]] = {
            "the connection that a page keeps": lambda: send_request("POST"),
            "a new connection": lambda: post_stop(console_address),
        }
        for name, stop in stops.items():
            answers: list[HttpAnswer] = []
            with hold_more_requests_than_files(console_address):
                stop_s = measure_stop_time(
                    robot, lambda stop=stop, answers=answers: answers.append(stop())
                )
            record_property(
                f"stopped without the page server by {name}", f"after {1000 * stop_s:.0f} ms"
            )
            assert stop_s < MAX_FLOODED_STOP_S
            assert_confirms_stop(answers[0])
            robot.operator.recover_robot()
    robot.assert_unharmed(health)
