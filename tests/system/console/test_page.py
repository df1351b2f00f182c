"""The console's page: who may open it, who may command, and what strangers can write on it."""

import asyncio
import socket
import threading

import msgspec
import numpy as np
import pytest

from snakesim_hal.base.errors import NotConnectedError
from snakesim_hal.model.scenario import load_scenario, make_start_capsules
from snakesim_operator.base.console_port import open_console_ports, open_port
from snakesim_operator.base.page_origin import explain_refusal
from snakesim_operator.features.console.control_token import ControlToken
from snakesim_operator.features.console.page import page_html
from snakesim_operator.features.console.robot_data.snapshot import (
    RobotSnapshot,
    make_expected_snapshot,
)
from snakesim_operator.features.console.scene.drawing import draw
from snakesim_operator.features.console.scene.scene_colors import LEGEND
from snakesim_operator.features.console.web.serve import serve_pages
from snakesim_testing.hal.small_robots import make_description, make_status
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.messages import raises_error
from snakesim_testing.operator.served_console import running_console, running_front_server
from snakesim_testing.operator.viewer import watch


def test_page_request_from_other_host_or_port_is_refused():
    for host in (
        "127.0.0.1:8080",
        "localhost:9000",
        "[::1]:8080",
        "localhost",
    ):  # a tunnel has another port
        assert explain_refusal(host, f"http://{host}") is None
        assert explain_refusal(host, None) is None
        assert explain_refusal(host, "http://evil.example")
        assert explain_refusal(host, "null")
        assert explain_refusal(host, "")
    assert "http://localhost:8081" in (
        explain_refusal("localhost:8080", "http://localhost:8081") or ""
    )
    assert "has to be a name of this computer" in (
        explain_refusal("evil.example:8080", "http://evil.example:8080") or ""
    )
    assert (
        explain_refusal("localhost:8080", "https://mine.example", also=["https://mine.example"])
        is None
    )


def test_page_port_in_use_is_an_error_without_fallback():
    with open_port(None) as first:
        port = first.getsockname()[1]  # 8080, or any free one
        with raises_error(NotConnectedError, code="network/port-in-use", mask=str(port)):
            open_port(port)


def test_a_browser_that_comes_before_the_page_gets_it():
    with open_console_ports(None) as ports:
        with socket.create_connection(ports.browser_socket.getsockname(), timeout=10.0) as early:
            early.sendall(f"GET /{ports.token}/ HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode())
            viewers = [threading.Thread(target=come, args=(ports.address,)) for _ in range(3)]
            for viewer in viewers:
                viewer.start()
            with (
                running_front_server(ports, None),
                serve_pages(ports.page_socket, has_stop=False) as server,
            ):
                assert early.recv(15) == b"HTTP/1.1 200 OK"
                wait_until(
                    lambda: len(server.get_clients()) == len(viewers), "the viewers that came early"
                )
        for viewer in viewers:
            viewer.join(10.0)


def come(address: str) -> None:
    asyncio.run(watch(address))


def test_nobody_can_open_a_tunnel_to_the_internet():
    with running_console() as (server, _):
        assert server.request_share_url() is None


def test_control_is_taken_while_free_and_never_taken_away():
    token = ControlToken()
    assert token.acquire(1)
    assert token.acquire(1)
    assert not token.acquire(2)
    assert token.holder == 1
    assert not token.release(2)
    assert token.holder == 1
    assert token.release(1)
    assert token.holder is None
    assert token.acquire(2)
    assert token.holder == 2


def test_text_from_the_network_is_no_markup():
    evil = "<img src=x onerror=alert(1)>\x1b[2J"
    robot = make_description()
    named = {"lease_holder": evil[:40], "alive": [evil[:40]], "waiting_for": [evil[:40]]}
    reported = make_status(
        lifecycle="fault", reason=evil, commands_rejected={evil[:40]: 1}, **named
    )
    snapshot = RobotSnapshot(robot=robot, status=reported)
    shown = (
        page_html.format_header(snapshot)
        + page_html.format_state_table(snapshot)
        + page_html.format_log([evil])
    )
    assert "<img" not in shown
    assert "&lt;img" in shown
    assert "\x1b" not in shown


def test_page_says_that_simulator_is_paused_and_by_whom():
    shown = page_html.format_header(
        RobotSnapshot(robot=make_description(), status=make_status(paused_by="<b>ada"))
    )
    assert ">PAUSED<" in shown
    assert "by &lt;b&gt;ada" in shown
    assert "PAUSED" not in page_html.format_header(
        RobotSnapshot(robot=make_description(), status=make_status())
    )


def test_page_draws_an_expected_robot_at_its_start():
    config = load_scenario("triplet").config
    snapshot = make_expected_snapshot(config)
    drawing = draw(snapshot, None)
    assert drawing is not None
    start = make_start_capsules(config)
    middles = [np.add(capsule.rear_m, capsule.front_m) / 2 for capsule in start]
    assert drawing.links_w[:, :2] == pytest.approx(np.array(middles))
    assert "WAITING FOR THE ROBOT" in page_html.format_header(snapshot)
    assert "SIMULATOR" not in page_html.format_header(snapshot)


@pytest.mark.parametrize(
    ("backend", "emulated", "words"),
    [
        ("sim", True, "EMULATED BY A SIMULATOR"),
        ("sim", False, "REAL ROBOT ON SIM"),  # a name alone says nothing
        ("can", True, "EMULATED ROBOT ON CAN"),
        ("can", False, "REAL ROBOT ON CAN"),
    ],
)
def test_the_page_says_what_moves(backend: str, emulated: bool, words: str):
    robot = msgspec.structs.replace(make_description(), backend=backend, emulated=emulated)
    assert f">{words}<" in page_html.format_header(RobotSnapshot(robot=robot))


def test_the_legend_has_a_colour_for_each_thing():
    assert len({color for _, color in LEGEND}) == len(LEGEND)
