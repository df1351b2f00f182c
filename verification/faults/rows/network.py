"""The network fails: its router dies, its cable is cut."""

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
from verification.faults.robot import START_LIMIT_S, ProcessRobot, configuration, recovered, robot
from verification.faults.row import InjectionTrial, MeasurementRequest

DOWN_S = 0.4  # how long there is no router
RECONNECT_S = 5.0
STEADY_S = 0.2
OURS, THEIRS = "10.99.7.1", "10.99.7.2"
PORT = 7447
CLONE_NEWNET = 0x40000000
INTERFACE = struct.Struct("16sH22x")  # struct ifreq of netdevice(7)
SIOCGIFFLAGS, SIOCSIFFLAGS, IFF_UP = 0x8913, 0x8914, 1
CUTS_S = (0.3, 0.5, 1.0, 3.0)  # the longest outlives Zenoh's own lease of a link


def router_restarts(request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """The router is killed and started again. The value: from the kill to the stop."""
    with robot(request, router=True) as (started_robot, observer):
        slowest_s = 0.0
        for _ in range(request.trials):
            started_robot.set_in_motion(observer)
            observer.watch(0.05)
            dead_ns = started_robot.signal("router", signal.SIGKILL)
            observer.watch(DOWN_S)
            stop = started_robot.host.wait_for_status(
                lambda status: status.lifecycle != "armed", dead_ns, "a stop"
            )
            observer.forget()
            started_robot.start("router")
            started = time.monotonic()
            observer.until(
                lambda: observer.statuses and observer.clocks, "reconnected", START_LIMIT_S
            )
            observer.until(lambda: _all_back(observer), "every service reconnected", START_LIMIT_S)
            took_s = time.monotonic() - started
            slowest_s = max(slowest_s, took_s)
            late = [f"reconnected only after {took_s:.1f} s"] if took_s > RECONNECT_S else []
            yield _after(observer, (stop.at_ns - dead_ns) / 1e6, late)
        request.note(
            f"everything connected again at most {slowest_s:.1f} s after the router's process was started again "
            f"(deadline {RECONNECT_S:g} s); the stop is observed over the host's private channel, without the network"
        )


def _all_back(observer: Observer) -> bool:
    status = observer.status
    return status is not None and not status.waiting_for and status.lease_holder == "control"


def _after(observer: Observer, value: float, failures: list[str]) -> InjectionTrial:
    """Still stopped, because of the lease; and back by an operator's commands."""
    observer.forget()
    observer.watch(STEADY_S)
    status = observer.status
    if status is None or status.lifecycle != "fault":
        return recovered(
            observer, None, "; ".join([*failures, f"not stopped: {observer.in_words()}"])
        )
    if any(h.message.sequence is not None for h in observer.applied):
        failures.append("commands were applied without an arm session")
    if not any(fault.what == "lease_expired" for fault in status.faults):
        failures.append(f"not because of the lease: {status.reason}")
    return recovered(observer, value, "; ".join(failures))


# --- a cable ---------------------------------------------------------------------------------------------------


def network_cut(request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """Host and observer on one side of a veth pair, the services on the other; the link goes down, and up again."""
    endpoint = f"tcp/{OURS}:{PORT}"
    with (
        _far_side() as far,
        ProcessRobot(
            request.folder, configuration(request.backend), endpoint=endpoint
        ) as started_robot,
    ):
        started_robot.start("host")
        observer = started_robot.observe()
        with _inside(far):
            for service in started_robot.config.services:
                started_robot.start(service)
        observer.arm(START_LIMIT_S)
        slowest_s = 0.0
        for number in range(request.trials):
            started_robot.set_in_motion(observer)
            cut_ns = time.monotonic_ns()
            _set_link("ours", up=False)
            value = observer.safe_after_ms(cut_ns)
            status = observer.first_fault(cut_ns)
            failures = (
                []
                if status.lease_holder is None
                else [f"the lease is still {status.lease_holder}'s"]
            )
            observer.watch(CUTS_S[number % len(CUTS_S)])
            observer.forget()
            _set_link("ours", up=True)
            started = time.monotonic()
            observer.until(lambda: _all_back(observer), "every service reconnected", START_LIMIT_S)
            slowest_s = max(slowest_s, time.monotonic() - started)
            if observer.state() != "fault" or any(
                h.message.sequence is not None for h in observer.applied
            ):
                failures.append(f"not latched: {observer.in_words()}")
            yield recovered(observer, value, "; ".join(failures))
        request.retry(observer.stumbles)
        request.note(
            f"two network namespaces with a veth pair, one end down for {CUTS_S[0]:g} to {CUTS_S[-1]:g} s; "
            f"everything connected again at most {slowest_s:.1f} s after the link was up"
        )


@contextlib.contextmanager
def _far_side() -> Iterator[Path]:
    """A network namespace behind a veth pair; this process must be in one of its own."""
    with contextlib.ExitStack() as stack:
        far = NamespaceMachine(stack, "the far side")
        _ip("link", "set", "lo", "up")
        _ip("link", "add", "ours", "type", "veth", "peer", "name", "theirs", "netns", far.pid)
        _ip("address", "add", f"{OURS}/24", "dev", "ours")
        _ip("link", "set", "ours", "up")
        far.set_address("theirs", f"{THEIRS}/24")
        yield Path(f"/proc/{far.pid}/ns/net")


@contextlib.contextmanager
def _inside(namespace: Path) -> Iterator[None]:
    """What this thread starts meanwhile is in that network namespace."""
    libc = ctypes.CDLL(None, use_errno=True)
    with open("/proc/thread-self/ns/net") as own, namespace.open() as other:  # noqa: PTH123 - both are held open
        if libc.setns(other.fileno(), CLONE_NEWNET):
            raise OSError(ctypes.get_errno(), "setns")
        try:
            yield
        finally:
            libc.setns(own.fileno(), CLONE_NEWNET)


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True, text=True, timeout=10)


def _set_link(name: str, *, up: bool) -> None:
    """What `ip link set` does, without the time that a process takes to start."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        interface_request = INTERFACE.pack(name.encode(), 0)
        _, flags = INTERFACE.unpack(fcntl.ioctl(any_socket, SIOCGIFFLAGS, interface_request))
        flags = flags | IFF_UP if up else flags & ~IFF_UP
        fcntl.ioctl(any_socket, SIOCSIFFLAGS, INTERFACE.pack(name.encode(), flags))
