"""What the attacks on a console share: how long a stop takes, and the process that serves the pages."""

import time
from collections.abc import Callable

import psutil

from snakesim_testing.harness.page import send_http_request
from snakesim_testing.harness.processes import find_processes_of_run
from snakesim_testing.harness.wait import wait_until
from verification.attack.robot import AttackedRobot

CONSOLE_MODULE = "snakesim_operator.features.console"
STOP_TIMEOUT_S = 60.0  # from an action to the stop, also on a busy machine
SELF_TEST_TIMEOUT_S = 10.0
MAX_OPEN_FILES = 1024  # of each process of the robot with a console
READY_ANSWER = (200, "ready")  # of the second stop


def measure_stop_time(robot: AttackedRobot, action: Callable[[], object]) -> float:
    """Return the time in s from an action until the robot is in an emergency stop."""
    start_s = time.monotonic()
    action()
    return robot.operator.wait_for_emergency_stop(start_s, STOP_TIMEOUT_S) - start_s


def wait_for_second_stop(console_address: str) -> None:
    """Wait until the second stop of a console has tested itself."""
    wait_until(
        lambda: send_http_request(console_address, "GET") == READY_ANSWER,
        "a second stop that is ready",
        SELF_TEST_TIMEOUT_S,
    )


def find_page_server(robot: AttackedRobot) -> int:
    """Return the id of the process that serves the pages, in which viser runs."""
    return next(
        process_id
        for process_id, command_line in find_processes_of_run(robot.run.out)
        if f"{CONSOLE_MODULE}\0" in command_line
    )


def measure_page_server_memory(robot: AttackedRobot) -> float:
    """Return the resident memory of the process that serves the pages, in MB."""
    return psutil.Process(find_page_server(robot)).memory_info().rss / 1e6


def list_listening_ports(process_id: int) -> list[int]:
    """Return the TCP ports on which a process listens."""
    connections = psutil.Process(process_id).net_connections("tcp")
    ports = [
        connection.laddr.port
        for connection in connections
        if connection.status == psutil.CONN_LISTEN
    ]
    assert ports, f"process {process_id} listens on no port"
    return ports
