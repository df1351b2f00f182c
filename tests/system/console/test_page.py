"""The console page restricts who may open it and command the robot, and escapes text from the network."""

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
    # A tunnel may have another port than the console.
    for host in ("127.0.0.1:8080", "localhost:9000", "[::1]:8080", "localhost"):
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
        port = first.getsockname()[1]  # 8080, or a free port if it is in use
        with raises_error(NotConnectedError, code="network/port-in-use", mask=str(port)):
            open_port(port)


def test_page_requested_before_its_server_starts_is_delivered():
    with open_console_ports(None) as ports:
        with socket.create_connection(
            ports.browser_socket.getsockname(), timeout=10.0
        ) as early_connection:
            early_connection.sendall(
                f"GET /{ports.token}/ HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode()
            )
            viewers = [threading.Thread(target=open_page, args=(ports.address,)) for _ in range(3)]
            for viewer in viewers:
                viewer.start()
            with (
                running_front_server(ports, None),
                serve_pages(ports.page_socket, has_stop=False) as server,
            ):
                assert early_connection.recv(15) == b"HTTP/1.1 200 OK"
                wait_until(lambda: len(server.get_clients()) == len(viewers), "the early viewers")
        for viewer in viewers:
            viewer.join(10.0)


def open_page(address: str) -> None:
    """Connect as a viewer until the page is closed."""
    asyncio.run(watch(address))


def test_page_offers_no_tunnel_to_the_internet():
    with running_console() as (server, _):
        assert server.request_share_url() is None


def test_control_token_is_acquired_only_while_free():
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


def test_page_escapes_text_from_the_network():
    markup = "<img src=x onerror=alert(1)>\x1b[2J"
    robot = make_description()
    names = {"lease_holder": markup[:40], "alive": [markup[:40]], "waiting_for": [markup[:40]]}
    status = make_status(
        lifecycle="fault", reason=markup, commands_rejected={markup[:40]: 1}, **names
    )
    snapshot = RobotSnapshot(robot=robot, status=status)
    html = (
        page_html.format_header(snapshot)
        + page_html.format_state_table(snapshot)
        + page_html.format_log([markup])
    )
    assert "<img" not in html
    assert "&lt;img" in html
    assert "\x1b" not in html


def test_page_of_paused_simulator_names_who_paused_it():
    html = page_html.format_header(
        RobotSnapshot(robot=make_description(), status=make_status(paused_by="<b>ada"))
    )
    assert ">PAUSED<" in html
    assert "by &lt;b&gt;ada" in html
    assert "PAUSED" not in page_html.format_header(
        RobotSnapshot(robot=make_description(), status=make_status())
    )


def test_page_without_robot_draws_expected_robot_at_its_start():
    config = load_scenario("triplet").config
    snapshot = make_expected_snapshot(config)
    drawing = draw(snapshot, None)
    assert drawing is not None
    start = make_start_capsules(config)
    expected_positions_m = [np.add(capsule.rear_m, capsule.front_m) / 2 for capsule in start]
    assert drawing.links_w[:, :2] == pytest.approx(np.array(expected_positions_m))
    assert "WAITING FOR THE ROBOT" in page_html.format_header(snapshot)
    assert "SIMULATOR" not in page_html.format_header(snapshot)


@pytest.mark.parametrize(
    ("backend", "emulated", "label"),
    [
        ("sim", True, "EMULATED BY A SIMULATOR"),
        ("sim", False, "REAL ROBOT ON SIM"),  # The name of the backend does not decide.
        ("can", True, "EMULATED ROBOT ON CAN"),
        ("can", False, "REAL ROBOT ON CAN"),
    ],
)
def test_page_header_states_whether_the_robot_is_real(backend: str, emulated: bool, label: str):
    robot = msgspec.structs.replace(make_description(), backend=backend, emulated=emulated)
    assert f">{label}<" in page_html.format_header(RobotSnapshot(robot=robot))


def test_page_legend_has_a_different_color_for_each_item():
    assert len({color for _, color in LEGEND}) == len(LEGEND)
