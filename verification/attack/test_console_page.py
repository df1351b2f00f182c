"""C1 to C4, C6 and C9: viewers, web pages and programs that misuse the page of a console.

They cannot command the robot, disable the stop for others, or end the console.
"""

from typing import Any

import pytest
from websockets.exceptions import InvalidStatus

from snakesim_testing.harness.page import (
    CAMERA,
    STOP,
    ViewerPage,
    origin_of,
    send_http_request,
)
from snakesim_testing.harness.processes import find_processes_with
from snakesim_testing.harness.wait import wait_until
from verification.attack.console import (
    CONSOLE_MODULE,
    find_page_server,
    list_listening_ports,
    measure_stop_time,
)
from verification.attack.robot import AttackedRobot

FORBIDDEN = 403
MESSAGE_TOO_BIG = 1009  # code with which a WebSocket is closed
FOREIGN_ORIGINS = (
    "http://evil.example",
    "null",
    "http://localhost:9",
    "http://127.0.0.1:9",
    "file://",
    "https://localhost",
)

# Updates of a button that try to change more than its value.
HARMFUL_UPDATES: tuple[Any, ...] = (
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

# Messages that no page of the console sends.
UNEXPECTED_MESSAGES: dict[str, Any] = {
    "share_url": {"type": "ShareUrlRequest"},
    "file": {
        "type": "FileTransferStartUpload",
        "source_component_uuid": "x",
        "transfer_uuid": "y",
        "filename": "../../x",
        "mime_type": "text/plain",
        "part_count": 1,
        "size_bytes": 10**12,
    },
    "javascript": {"type": "RunJavascriptMessage", "source": "alert(1)"},
    "form": {"type": "GuiFormDirtyMessage", "uuid": "x"},
    "camera_with_extra_field": CAMERA | {"excluded_self_client": 0},
    "camera_at_infinity": CAMERA | {"position": [float("inf"), float("nan"), 0.0]},
    "no_type": {"uuid": "x", "updates": {"value": True}},
    "type_is_a_list": {"type": ["GuiUpdateMessage"], "uuid": "x"},
    "unknown_type": {"type": "GuiSetAnythingMessage", "uuid": "x", "value": 1},
    "list": [1, 2, 3],
    "random_bytes": b"\xc1\xff\x00\x93",
    "empty": b"",
    "text": '{"type": "GuiUpdateMessage"}',
    "deeply_nested": b"\x91" * 60_000,
}

# Values for controls of every kind; the console rejects those that a control cannot have.
CONTROL_VALUES = ("Disarm", "Reset", "Inject", 90, 0.4, True)


def read_console_log(robot: AttackedRobot) -> str:
    """Return everything that the console has logged."""
    return (robot.run.out / "console.log").read_text()


def test_c1_no_viewer_switches_the_stop_off(
    robot_with_console: AttackedRobot, console_address: str
) -> None:
    health = robot_with_console.record_health()
    with ViewerPage(console_address) as attacker, ViewerPage(console_address) as other:
        for update in HARMFUL_UPDATES * 2:
            attacker.change(attacker.find(STOP), update)
        attacker.send_message(CAMERA)
        robot_with_console.assert_stays("armed", 0.5)
        measure_stop_time(robot_with_console, lambda: other.click(STOP))
    robot_with_console.operator.recover_robot()
    with ViewerPage(console_address) as later:
        measure_stop_time(robot_with_console, lambda: later.click(STOP))
    robot_with_console.assert_unharmed(health)


def use_control(attacker: ViewerPage, control: str, properties: dict[str, Any]) -> None:
    """Send every message that might use a control of a page.

    Args:
        attacker: Viewer that sends the messages.
        control: Id of the control.
        properties: Properties of the control, as the console sent them.
    """
    for value in (*CONTROL_VALUES, *properties.get("options", ())):
        attacker.change(control, {"value": value})
    attacker.send_message({"type": "GuiButtonHoldMessage", "uuid": control, "frequency": 10.0})
    if "hotkey" in properties and properties.get("label") != "Emergency stop":
        attacker.send_message({"type": "CommandTriggerMessage", "uuid": control})


def test_c2_user_without_control_cannot_command_by_any_button(
    robot_with_console: AttackedRobot, console_address: str
) -> None:
    robot = robot_with_console
    health = robot.record_health()
    with ViewerPage(console_address) as driver, ViewerPage(console_address) as attacker:
        driver.click("Take control")
        driver.find("Release control")
        for page in (driver, attacker):
            page.find("Robot")
            for control, properties in list(page.controls.items()):
                label = properties.get("label")
                if label == STOP:
                    continue
                if label == "Release control":
                    assert page is driver, "only the viewer with control can release it"
                use_control(attacker, control, properties)
        robot.assert_stays("armed", 1.5)
        assert driver.find("Release control")
        for reason in ("without control of the robot", "no control of this viewer"):
            wait_until(lambda reason=reason: reason in read_console_log(robot), reason)
        measure_stop_time(robot, lambda: attacker.click(STOP))
    robot.assert_unharmed(health)


def test_c3_unexpected_page_message_ends_nothing_and_is_reported_once(
    robot_with_console: AttackedRobot, console_address: str
) -> None:
    health = robot_with_console.record_health()
    with ViewerPage(console_address) as attacker:
        attacker.find(STOP)
        for message in [*UNEXPECTED_MESSAGES.values()] * 3:
            attacker.send_message(message)
        # The same connection can still stop the robot.
        measure_stop_time(robot_with_console, lambda: attacker.click(STOP))
    robot_with_console.assert_unharmed(health)
    assert read_console_log(robot_with_console).count(": unknown:") == 1


def test_c4_a_client_that_sends_too_much_is_disconnected(
    robot_with_console: AttackedRobot, console_address: str
) -> None:
    health = robot_with_console.record_health()
    with ViewerPage(console_address) as attacker, ViewerPage(console_address) as other:
        attacker.change(attacker.find(STOP), {"value": "x" * 1_000_000})
        assert attacker.ended() == MESSAGE_TOO_BIG
        measure_stop_time(robot_with_console, lambda: other.click(STOP))
    robot_with_console.assert_unharmed(health)


def test_c6_pages_of_other_origins_are_refused(
    robot_with_console: AttackedRobot, console_address: str
) -> None:
    own_origin = origin_of(console_address)
    # Another name of the same computer is another origin.
    localhost_origin = own_origin.replace("127.0.0.1", "localhost")
    for origin in (*FOREIGN_ORIGINS, localhost_origin):
        with pytest.raises(InvalidStatus) as refused:
            ViewerPage(console_address, origin)
        assert refused.value.response.status_code == FORBIDDEN
        for method in ("GET", "POST"):
            status, text = send_http_request(console_address, method, Origin=origin)
            assert status == FORBIDDEN, f"{origin}: {status}"
            assert "may connect" in text, text
    # A name of an attacker's site may resolve to the address of the console.
    evil_host = {"Host": "evil.example"}
    evil_page = {**evil_host, "Origin": "http://evil.example"}
    assert send_http_request(console_address, "GET", "/", **evil_host)[0] == FORBIDDEN
    assert send_http_request(console_address, "POST", **evil_page)[0] == FORBIDDEN
    with ViewerPage(console_address, own_origin) as page:
        page.find(STOP)
    robot_with_console.assert_stays("armed", 0.3)


def list_wrong_tokens(token: str) -> tuple[str, ...]:
    """Return tokens that are not that of the console, some of them similar."""
    similar_tokens = (token[:-1], token + "x", token.swapcase())
    return ("", "wrong", "stop", "..", "%2e%2e", "index.html", *similar_tokens)


def test_c9_without_the_token_nothing_is_answered(
    robot_with_console: AttackedRobot, console_address: str
) -> None:
    health = robot_with_console.record_health()
    origin = origin_of(console_address)
    token = console_address.rstrip("/").rpartition("/")[2]
    requests = (("POST", "/stop"), ("GET", "/stop"), ("GET", "/"), ("GET", "/signals"))
    for wrong_token in list_wrong_tokens(token):
        wrong_address = f"{origin}/{wrong_token}"
        for method, path in requests:
            status, text = send_http_request(wrong_address, method, path, Origin=origin)
            assert status == FORBIDDEN, f"{method} {wrong_address}{path}: {status}"
            assert "the address that the console printed" in text, text
        with pytest.raises(InvalidStatus):
            ViewerPage(wrong_address, origin)
    with ViewerPage(console_address) as viewer:
        stop_button = viewer.find(STOP)
        # Viser has a port of its own, behind the front server.
        for port in list_listening_ports(find_page_server(robot_with_console)):
            with ViewerPage(f"http://127.0.0.1:{port}") as attacker:
                attacker.change(stop_button, {"value": True})
                attacker.change(stop_button, {"visible": False})
                assert attacker.ended() is None, "the connection must end without a code"
                assert not attacker.controls
        robot_with_console.assert_stays("armed", 0.5)
        assert viewer.controls[stop_button].get("visible", True)
        measure_stop_time(robot_with_console, lambda: viewer.click(STOP))
    robot_with_console.assert_unharmed(health)
    # Every user of the computer can read command lines.
    command_lines = [line for _, line in find_processes_with("cmdline", CONSOLE_MODULE)]
    assert command_lines
    assert not any(token in line for line in command_lines), "a command line contains the token"
