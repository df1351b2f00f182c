"""C1 to C10: a stranger in a browser. Nothing that a page says keeps the stop from anybody, or commands the robot."""

import http.client
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from typing import Any
from urllib.parse import urlsplit

import psutil
import pytest
from websockets.exceptions import InvalidStatus

from snakesim_testing.harness.page import (
    CAMERA,
    STOP,
    ViewerPage,
    flood,
    origin_of,
    send_http_request,
)
from snakesim_testing.harness.processes import find_processes_of_run, find_processes_with
from snakesim_testing.harness.wait import wait_until
from verification.attack.command import address
from verification.attack.effort import Record, effort
from verification.attack.means.floods import half_sent
from verification.attack.robot import AttackedRobot, Victim

STOP_S = 60.0  # from a click to the stop; far above what it takes
FLOOD_S = float(effort(2, 20))
FILES = 1024  # that each process of the robot may open
# What is promised for a stop while requests flood the console; it takes some 0.02 s.
FLOODED_STOP_S = 5.0
MOST_MB = 80.0  # that a flood may cost the console
REFUSED = (
    "http://evil.example",
    "null",
    "http://localhost:9",
    "http://127.0.0.1:9",
    "file://",
    "https://localhost",
)


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Victim]:
    kept = Victim(
        tmp_path_factory.mktemp("shown"),
        "--console",
        inside=("prlimit", f"--nofile={FILES}:{FILES}"),
    )
    yield kept
    kept.close()


@pytest.fixture
def robot(shown: Victim) -> AttackedRobot:
    return shown.armed()


@pytest.fixture
def at(robot: AttackedRobot) -> str:
    """The console's address."""
    return robot.run.console()


def stops(robot: AttackedRobot, act: Callable[[], object]) -> float:
    """Seconds from an act until the robot is stopped."""
    asked_s = time.monotonic()
    act()
    return robot.operator.stopped_at(asked_s, STOP_S) - asked_s


UPDATES: tuple[Any, ...] = (
    {"update_cb": []},
    {"__class__": 1},
    {"value": True, "update_cb": []},
    {"removed": True},
    {"is_button": False, "value": False},
    {"sync_cb": None},
    {"gui_api": None},
    {"value": ["update_cb"]},
    {},
    [],
)


def test_c1_no_viewer_switches_the_stop_off(robot: AttackedRobot, at: str) -> None:
    health = robot.health()
    with ViewerPage(at) as viewer, ViewerPage(at) as other:
        for one in UPDATES * 2:
            viewer.change(viewer.find(STOP), one)
        viewer.send_message(CAMERA)
        robot.stays("armed", 0.5)
        stops(robot, lambda: other.click(STOP))
    robot.operator.recover()
    with ViewerPage(at) as late:
        stops(robot, lambda: late.click(STOP))
    robot.unharmed(health)


def test_c2_user_without_control_cannot_command_by_any_button(
    robot: AttackedRobot, at: str
) -> None:
    health = robot.health()
    with ViewerPage(at) as driver, ViewerPage(at) as intruder:
        driver.click("Take control")
        driver.find("Release control")
        for page in (driver, intruder):
            page.find("Robot")
            for control, props in list(page.controls.items()):
                if props.get("label") == STOP:
                    continue
                if props.get("label") == "Release control":  # of somebody else
                    assert page is driver
                for value in (
                    "Disarm",
                    "Reset",
                    "Inject",
                    90,
                    0.4,
                    True,
                    *props.get("options", ()),
                ):
                    intruder.change(control, {"value": value})
                intruder.send_message(
                    {"type": "GuiButtonHoldMessage", "uuid": control, "frequency": 10.0}
                )
                if "hotkey" in props and props.get("label") != "Emergency stop":
                    intruder.send_message({"type": "CommandTriggerMessage", "uuid": control})
        robot.stays("armed", 1.5)
        assert driver.find("Release control")
        for said in ("without control of the robot", "no control of this viewer"):
            wait_until(lambda said=said: said in (robot.run.out / "console.log").read_text(), said)
        stops(robot, lambda: intruder.click(STOP))
    robot.unharmed(health)


NONSENSE: dict[str, Any] = {
    "sharing": {"type": "ShareUrlRequest"},
    "a_file": {
        "type": "FileTransferStartUpload",
        "source_component_uuid": "x",
        "transfer_uuid": "y",
        "filename": "../../x",
        "mime_type": "text/plain",
        "part_count": 1,
        "size_bytes": 10**12,
    },
    "javascript": {"type": "RunJavascriptMessage", "source": "alert(1)"},
    "a_form": {"type": "GuiFormDirtyMessage", "uuid": "x"},
    "a_camera_with_more": CAMERA | {"excluded_self_client": 0},
    "a_camera_at_infinity": CAMERA | {"position": [float("inf"), float("nan"), 0.0]},
    "no_type": {"uuid": "x", "updates": {"value": True}},
    "a_type_that_is_none": {"type": ["GuiUpdateMessage"], "uuid": "x"},
    "a_type_of_tomorrow": {"type": "GuiSetAnythingMessage", "uuid": "x", "value": 1},
    "a_list": [1, 2, 3],
    "noise": b"\xc1\xff\x00\x93",
    "nothing": b"",
    "a_text": '{"type": "GuiUpdateMessage"}',
    "depth": b"\x91" * 60_000,
}


def test_c3_unexpected_page_message_ends_nothing_and_is_reported_once(
    robot: AttackedRobot, at: str
) -> None:
    health = robot.health()
    with ViewerPage(at) as viewer:
        viewer.find(STOP)
        for said in [*NONSENSE.values()] * 3:
            viewer.send_message(said)
        stops(robot, lambda: viewer.click(STOP))  # by the same connection, after it
    robot.unharmed(health)
    assert (robot.run.out / "console.log").read_text().count(": unknown:") == 1


def test_c4_a_client_that_sends_too_much_is_disconnected(robot: AttackedRobot, at: str) -> None:
    health = robot.health()
    with ViewerPage(at) as viewer, ViewerPage(at) as other:
        viewer.change(viewer.find(STOP), {"value": "x" * 1_000_000})
        assert viewer.ended() == 1009
        stops(robot, lambda: other.click(STOP))
    robot.unharmed(health)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["camera", "unknown", "stop"])
def test_c5_a_flood_costs_nobody_the_stop(
    robot: AttackedRobot, at: str, kind: str, record_property: Record
) -> None:
    health = robot.health()
    with ViewerPage(at) as other, ExitStack() as stack:
        button = other.find(STOP)
        said = {
            "camera": CAMERA,
            "unknown": {"type": "GuiUpdateMessage", "uuid": button, "updates": {"update_cb": []}},
            "stop": {"type": "GuiUpdateMessage", "uuid": button, "updates": {"value": True}},
        }[kind]
        before_mb = console_mb(robot)
        floods = [
            threading.Thread(target=flood, args=(at, said, FLOOD_S + 2.0))
            for _ in range(effort(3, 12))
        ]
        for one in floods:
            one.start()
            stack.callback(one.join)
        if kind == "stop":
            robot.operator.stopped_at(time.monotonic() - 1.0, STOP_S)
        else:
            time.sleep(FLOOD_S)
            record_property(
                "stopped after", f"{stops(robot, lambda: other.click(STOP)):.2f} s from a click"
            )
        began = time.monotonic()
        assert send_http_request(at, "GET") == (200, "ready")
        record_property("second stop answers", f"{1000 * (time.monotonic() - began):.0f} ms")
    assert console_mb(robot) < before_mb + MOST_MB
    robot.unharmed(health, kind)


def console_mb(robot: AttackedRobot) -> float:
    """Resident memory of the console."""
    return psutil.Process(pages_pid(robot)).memory_info().rss / 1e6


def pages_pid(robot: AttackedRobot) -> int:
    """Process id of the console's page server, where viser is."""
    return next(
        pid
        for pid, line in find_processes_of_run(robot.run.out)
        if "snakesim_operator.features.console\0" in line
    )


def test_c6_pages_of_other_origins_are_refused(robot: AttackedRobot, at: str) -> None:
    for origin in (
        *REFUSED,
        origin_of(at).replace("127.0.0.1", "localhost"),
    ):  # another name: another origin
        with pytest.raises(InvalidStatus) as refused:
            ViewerPage(at, origin)
        assert refused.value.response.status_code == 403
        for method in ("GET", "POST"):
            status, why = send_http_request(at, method, Origin=origin)
            assert status == 403 and "may connect" in why
    # A name of theirs that points here.
    assert send_http_request(at, "GET", "/", Host="evil.example")[0] == 403
    assert (
        send_http_request(at, "POST", Host="evil.example", Origin="http://evil.example")[0] == 403
    )
    with ViewerPage(at, origin_of(at)) as own:
        own.find(STOP)
    robot.stays("armed", 0.3)


def test_c7_the_second_stop_needs_nothing_of_the_page(
    robot: AttackedRobot, at: str, record_property: Record
) -> None:
    health = robot.health()
    with ExitStack() as stack:
        for said in (b"", b"POST /stop HTTP/1.1\r\nHost: ", b"GET / HTTP/1.1\r\n") * effort(
            40, 100
        ):
            half = stack.enter_context(
                socket.create_connection(address(origin_of(at).replace("http://", "tcp/")))
            )
            half.sendall(said)
        answers: list[tuple[int, str]] = []
        took_s = stops(
            robot, lambda: answers.append(send_http_request(at, "POST", Origin=origin_of(at)))
        )
        assert answers[0][0] == 200 and "planar13: stopped" in answers[0][1]
    record_property("stopped after", f"{1000 * took_s:.0f} ms from POST /stop")
    assert (
        'id = "second-stop"' in send_http_request(at, "GET", "/")[1]
        and send_http_request(at, "GET", "/")[0] == 200
    )
    robot.unharmed(health)


def test_c8_half_sent_requests_do_not_block_the_stop(
    robot: AttackedRobot, at: str, record_property: Record
) -> None:
    """With more of them than the console may open files, by all of its stops, during the flood and after it."""
    health = robot.health()
    with ViewerPage(at) as page, ViewerPage(at, draws=False) as without_scene:
        ways: dict[str, Callable[[], object]] = {
            "the page's button": lambda: page.click(STOP),
            "the button of a page without WebGL": lambda: without_scene.click(STOP),
            "POST /stop": lambda: send_http_request(at, "POST", Origin=origin_of(at)),
        }
        page.find(STOP)
        without_scene.find(STOP)
        with half_sent(at, count=2000, process_count=3):
            for name, act in ways.items():
                took_s = stops(robot, act)
                record_property(f"stopped in the flood by {name}", f"after {1000 * took_s:.0f} ms")
                assert took_s < FLOODED_STOP_S, name
                robot.operator.recover()
            wait_until(
                lambda: send_http_request(at, "GET") == (200, "ready"),
                "a second stop that has tested itself",
                10.0,
            )
        for name, act in ways.items():
            assert stops(robot, act) < FLOODED_STOP_S, name
            robot.operator.recover()
        with ViewerPage(at) as late:
            late.find(STOP)
    robot.unharmed(health)


WRONG_TOKENS = ("", "wrong", "stop", "..", "%2e%2e", "index.html")


def test_c9_without_the_token_nothing_is_answered(robot: AttackedRobot, at: str) -> None:
    """Neither by the address without it, nor with a wrong one, nor at the port of viser itself."""
    health = robot.health()
    token = at.rstrip("/").rpartition("/")[2]
    for wrong in (*WRONG_TOKENS, token[:-1], token + "x", token.swapcase()):
        address_without = f"{origin_of(at)}/{wrong}"
        for method, path in (
            ("POST", "/stop"),
            ("GET", "/stop"),
            ("GET", "/"),
            ("GET", "/signals"),
        ):
            status, why = send_http_request(address_without, method, path, Origin=origin_of(at))
            assert status == 403 and "the address that the console printed" in why
        with pytest.raises(InvalidStatus):
            ViewerPage(address_without, origin_of(at))
    with ViewerPage(at) as viewer:
        button = viewer.find(STOP)
        for port in listening_ports(pages_pid(robot)):
            with ViewerPage(f"http://127.0.0.1:{port}") as intruder:
                intruder.change(button, {"value": True})
                intruder.change(button, {"visible": False})
                assert intruder.ended() is None and not intruder.controls, "closed without a word"
        robot.stays("armed", 0.5)
        assert viewer.controls[button].get("visible", True)
        stops(robot, lambda: viewer.click(STOP))
    robot.unharmed(health)
    command_lines = [
        line for _, line in find_processes_with("cmdline", "snakesim_operator.features.console")
    ]
    assert command_lines and not any(token in line for line in command_lines), (
        "every user reads command lines"
    )


def listening_ports(pid: int) -> list[int]:
    """The TCP ports on which a process listens."""
    connections = psutil.Process(pid).net_connections("tcp")
    ports = [one.laddr.port for one in connections if one.status == psutil.CONN_LISTEN]
    assert ports
    return ports


@contextmanager
def kept_connection(at: str) -> Iterator[Callable[[str], tuple[int, str]]]:
    """Requests for the second stop over one connection, as a page sends them."""
    parts = urlsplit(at)
    with closing(http.client.HTTPConnection(parts.netloc, timeout=20.0)) as connection:

        def ask_again(method: str) -> tuple[int, str]:
            connection.request(method, f"{parts.path}stop", headers={"Origin": origin_of(at)})
            answer = connection.getresponse()
            return answer.status, answer.read().decode()

        yield ask_again


def test_c10_the_second_stop_works_while_the_process_of_the_pages_is_stopped(
    robot: AttackedRobot, at: str, record_property: Record
) -> None:
    health = robot.health()
    pid = pages_pid(robot)
    wait_until(
        lambda: send_http_request(at, "GET") == (200, "ready"),
        "a second stop that has tested itself",
        10.0,
    )
    os.kill(pid, signal.SIGSTOP)
    try:
        with kept_connection(at) as ask_again:
            assert ask_again("GET") == (200, "ready")
            ways: dict[str, Callable[[], tuple[int, str]]] = {
                "the connection that a page keeps": lambda: ask_again("POST"),
                "a new connection": lambda: send_http_request(at, "POST", Origin=origin_of(at)),
            }
            for name, act in ways.items():
                answers: list[tuple[int, str]] = []
                with half_sent(at, count=2000, process_count=3):
                    took_s = stops(robot, lambda act=act, answers=answers: answers.append(act()))
                record_property(
                    f"stopped without the pages' process by {name}", f"after {1000 * took_s:.0f} ms"
                )
                assert took_s < FLOODED_STOP_S
                assert answers[0][0] == 200 and "planar13: stopped" in answers[0][1]
                robot.operator.recover()
    finally:
        os.kill(pid, signal.SIGCONT)
    robot.unharmed(health)
