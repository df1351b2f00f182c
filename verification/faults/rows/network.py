"""Measures faults of the network: its router is killed, or its cable is cut."""

import contextlib
import ctypes
import fcntl
import signal
import socket
import struct
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

from snakesim_testing.lab.machines import NamespaceMachine
from verification.faults.observer import Observer
from verification.faults.robot import (
    START_TIMEOUT_S,
    ProcessRobot,
    make_config,
    recover_robot,
    start_robot,
)
from verification.faults.row import InjectionTrial, MeasurementRequest

COMMAND_STREAM_S = 0.05  # in which commands flow before the router is killed
ROUTER_DOWN_S = 0.4
MAX_RECONNECTION_S = 5.0
STOPPED_S = 0.2  # in which a robot must remain stopped
CUT_DURATIONS_S = (0.3, 0.5, 1.0, 3.0)  # the longest is longer than Zenoh's lease of a link

HOST_ADDRESS = "10.99.7.1"
SERVICES_ADDRESS = "10.99.7.2"
HOST_INTERFACE = "ours"
SERVICES_INTERFACE = "theirs"
PORT = 7447

# From the headers of Linux; Python does not define them.
CLONE_NEWNET = 0x40000000
INTERFACE_REQUEST = struct.Struct("16sH22x")  # struct ifreq of netdevice(7): name and flags
SIOCGIFFLAGS = 0x8913
SIOCSIFFLAGS = 0x8914
IFF_UP = 1


# --- the router restarts -------------------------------------------------------------------------------------------


def measure_router_restart(request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """Kill the router while the robot moves, and start a new one.

    Yields:
        Trials whose value is the time from the kill to the stop, in ms.
    """
    with start_robot(request, has_router_process=True) as (robot, observer):
        max_reconnection_s = 0.0
        for _ in range(request.trials):
            robot.set_in_motion(observer)
            observer.listen_for(COMMAND_STREAM_S)
            kill_ns = robot.send_signal("router", signal.SIGKILL)
            observer.listen_for(ROUTER_DOWN_S)
            stop = robot.host_watch.wait_for_status(
                lambda status: status.lifecycle != "armed", kill_ns, "a stop"
            )
            delay_ms = (stop.at_ns - kill_ns) / 1e6
            reconnection_s = _restart_router(robot, observer)
            max_reconnection_s = max(max_reconnection_s, reconnection_s)
            failures: list[str] = []
            if reconnection_s > MAX_RECONNECTION_S:
                failures.append(f"reconnected only after {reconnection_s:.1f} s")
            yield _finish_router_trial(observer, delay_ms, failures)
        request.add_note(
            f"everything connected again at most {max_reconnection_s:.1f} s after the router's process was started "
            f"again (deadline {MAX_RECONNECTION_S:g} s); the stop is observed over the host's private channel, without "
            "the network"
        )


def _restart_router(robot: ProcessRobot, observer: Observer) -> float:
    """Start the router again. Return the time until every process was connected, in s."""
    observer.forget()
    robot.start_process("router")
    start_s = time.monotonic()
    observer.wait_until(
        lambda: observer.statuses and observer.clocks, "reconnected", START_TIMEOUT_S
    )
    _wait_for_services(observer)
    return time.monotonic() - start_s


def _wait_for_services(observer: Observer) -> None:
    """Wait until every service is connected, and the controller holds the lease."""

    def are_connected() -> bool:
        status = observer.status
        return status is not None and not status.waiting_for and status.lease_holder == "control"

    observer.wait_until(are_connected, "every service reconnected", START_TIMEOUT_S)


def _finish_router_trial(
    observer: Observer, delay_ms: float, failures: list[str]
) -> InjectionTrial:
    """Check that the robot remains stopped because of the lease, and recover it."""
    observer.forget()
    observer.listen_for(STOPPED_S)
    status = observer.status
    if status is None or status.lifecycle != "fault":
        failures.append(f"not stopped: {observer.describe_status()}")
        return recover_robot(observer, None, failures)
    if observer.has_applied_commands():
        failures.append("commands were applied without an arm session")
    if not any(fault.what == "lease_expired" for fault in status.faults):
        failures.append(f"not because of the lease: {status.reason}")
    return recover_robot(observer, delay_ms, failures)


# --- a cable is cut ------------------------------------------------------------------------------------------------


def measure_cut_network(request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """Cut the link between the host and the services while the robot moves, and connect it again.

    Host and observer are in the network namespace of this process, the services in another one.

    Yields:
        Trials whose value is the time from the cut to the stop mode, in ms.
    """
    config = make_config(request.backend)
    with (
        _make_services_namespace() as namespace,
        ProcessRobot(request.folder, config, endpoint=f"tcp/{HOST_ADDRESS}:{PORT}") as robot,
    ):
        robot.start_process("host")
        observer = robot.connect_observer()
        with _enter_namespace(namespace):
            for service in robot.config.services:
                robot.start_process(service)
        observer.arm(START_TIMEOUT_S)
        max_reconnection_s = 0.0
        for number in range(request.trials):
            robot.set_in_motion(observer)
            cut_duration_s = CUT_DURATIONS_S[number % len(CUT_DURATIONS_S)]
            delay_ms, failures = _cut_link(observer, cut_duration_s)
            start_s = time.monotonic()
            _wait_for_services(observer)
            max_reconnection_s = max(max_reconnection_s, time.monotonic() - start_s)
            if observer.get_lifecycle() != "fault" or observer.has_applied_commands():
                failures.append(f"not latched: {observer.describe_status()}")
            yield recover_robot(observer, delay_ms, failures)
        request.count_retries(observer.failed_armings)
        request.add_note(
            f"two network namespaces with a veth pair, one end down for {CUT_DURATIONS_S[0]:g} to "
            f"{CUT_DURATIONS_S[-1]:g} s; "
            f"everything connected again at most {max_reconnection_s:.1f} s after the link was up"
        )


def _cut_link(observer: Observer, duration_s: float) -> tuple[float, list[str]]:
    """Cut the link for a while.

    Returns:
        The time from the cut to the stop mode in ms, and a description of each violation.
    """
    cut_ns = time.monotonic_ns()
    _set_link(HOST_INTERFACE, is_up=False)
    delay_ms = observer.measure_stop_delay_ms(cut_ns)
    status = observer.wait_for_fault(cut_ns)
    failures: list[str] = []
    if status.lease_holder is not None:
        failures.append(f"the lease is still {status.lease_holder}'s")
    observer.listen_for(duration_s)
    observer.forget()
    _set_link(HOST_INTERFACE, is_up=True)
    return delay_ms, failures


@contextlib.contextmanager
def _make_services_namespace() -> Iterator[Path]:
    """Connect a new network namespace to the namespace of this process, and yield its path.

    This process must already be in a network namespace of its own.
    """
    with contextlib.ExitStack() as stack:
        machine = NamespaceMachine(stack, "the far side")
        _run_ip("link set lo up")
        _run_ip(
            f"link add {HOST_INTERFACE} type veth peer name {SERVICES_INTERFACE} netns {machine.pid}"
        )
        _run_ip(f"address add {HOST_ADDRESS}/24 dev {HOST_INTERFACE}")
        _run_ip(f"link set {HOST_INTERFACE} up")
        machine.set_address(SERVICES_INTERFACE, f"{SERVICES_ADDRESS}/24")
        yield Path(f"/proc/{machine.pid}/ns/net")


@contextlib.contextmanager
def _enter_namespace(namespace: Path) -> Iterator[None]:
    """Move this thread into another network namespace. Processes that it starts meanwhile are in it, too."""
    libc = ctypes.CDLL(None, use_errno=True)
    with open("/proc/thread-self/ns/net") as own, namespace.open() as other:  # noqa: PTH123 - both are held open
        if libc.setns(other.fileno(), CLONE_NEWNET):
            raise OSError(ctypes.get_errno(), "setns")
        try:
            yield
        finally:
            libc.setns(own.fileno(), CLONE_NEWNET)


def _run_ip(arguments: str) -> None:
    command = ["ip", *arguments.split()]
    subprocess.run(command, check=True, capture_output=True, text=True, timeout=10)


def _set_link(name: str, *, is_up: bool) -> None:
    """Set a network interface up or down, without the time that the process of `ip link set` takes to start."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        query = INTERFACE_REQUEST.pack(name.encode(), 0)
        _, flags = INTERFACE_REQUEST.unpack(fcntl.ioctl(any_socket, SIOCGIFFLAGS, query))
        flags = flags | IFF_UP if is_up else flags & ~IFF_UP
        fcntl.ioctl(any_socket, SIOCSIFFLAGS, INTERFACE_REQUEST.pack(name.encode(), flags))
