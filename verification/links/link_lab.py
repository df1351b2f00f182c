"""A robot whose host, router and services run on three machines, each a network namespace.

The host is armed and watched over its private channel. This channel is a socket pair, so the network does not affect
what a test measures of the host.
"""

import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Literal

from snakesim_hal.model.scenario import RunConfig, load_scenario, parse_set_option, write_config
from snakesim_hal.network.private_channel import StarterEnd, socket_pair
from snakesim_hal.wire.messages import LifecycleRequest, RobotStatus
from snakesim_testing.lab.machines import (
    NamespaceMachine,
    RadioLink,
    connect_by_cable,
    connect_by_radio,
)
from snakesim_testing.runs.command import SNAKESIM_COMMAND

SCENARIO = "triplet"
SET_OPTIONS = ("clock_mode=realtime", "duration_s=86400")
ROBOT_NET = "10.77.1"
WORKSTATION_NET = "10.77.2"
ROUTER_PORT = 7447
ROUTER_FOR_ROBOT = f"tcp/{ROBOT_NET}.1:{ROUTER_PORT}"
ROUTER_FOR_WORKSTATION = f"tcp/{WORKSTATION_NET}.1:{ROUTER_PORT}"
WAIT_TIMEOUT_S = 60.0
STATUS_POLL_S = 0.001  # the stop takes about 50 ms, and is measured to one millisecond
ARM_REQUEST_INTERVAL_S = 0.02
LOG_TAIL_CHARACTERS = 500


class LinkLab:
    """Three machines: one with the host, one with the router, and one with the services.

    The link between router and services (`link`) can be made bad or cut. The router can be killed and started again.
    """

    def __init__(self, folder: Path, stack: ExitStack, *set_options: str) -> None:
        """Create the machines, and start all programs.

        Args:
            folder: Folder for the configuration, the record of the run, and the logs.
            stack: Ends the programs and the machines.
            set_options: Changes of the scenario, as `--set` takes them.
        """
        self.folder = folder
        self.config: RunConfig = load_scenario(
            SCENARIO, [parse_set_option(option) for option in (*SET_OPTIONS, *set_options)]
        ).config
        self._config_path = folder / "config.json"
        write_config(self.config, self._config_path)
        os.environ["XDG_STATE_HOME"] = str(folder)

        # Machines and their links.
        self.router_machine = NamespaceMachine(stack)
        self.robot = NamespaceMachine(stack)
        self.workstation = NamespaceMachine(stack)
        connect_by_cable(self.router_machine, self.robot, "robot", ROBOT_NET)
        self.link: RadioLink = stack.enter_context(
            connect_by_radio(self.router_machine, self.workstation, "workstation", WORKSTATION_NET)
        )

        # Programs.
        self.start_router()
        self.host = self._start_host()
        for service in self.config.services:
            self._start_service(service)

    def start_router(self) -> None:
        """Start a router."""
        self._router = self.router_machine.start_module(
            "snakesim_hal.programs.router_program",
            str(self._config_path),
            "--endpoint",
            f"tcp/0.0.0.0:{ROUTER_PORT}",
            "--insecure",
            log=self.folder / "router.log",
            hurried=True,
        )

    def kill_router(self) -> None:
        """Kill the router with SIGKILL, so that it cannot close its connections."""
        self._router.send_signal(signal.SIGKILL)
        self._router.wait()

    def start_recorder(self) -> Path:
        """Start a recorder on the machine of the services, and return the path of its recording."""
        recording = self.folder / "recording.mcap"
        self.workstation.start(
            *SNAKESIM_COMMAND,
            "record",
            "--out",
            str(recording),
            "--router",
            ROUTER_FOR_WORKSTATION,
            log=self.folder / "recorder.log",
        )
        return recording

    def _start_host(self) -> StarterEnd:
        """Start the host, and return this process's end of its private channel."""
        starter_socket, host_socket = socket_pair()
        with host_socket:
            self.robot.start_module(
                "snakesim_hal.programs.host_program",
                str(self._config_path),
                "--router",
                ROUTER_FOR_ROBOT,
                "--out",
                str(self.folder),
                "--parent-socket",
                str(host_socket.fileno()),
                log=self.folder / "host.log",
                inherits=[host_socket.fileno()],
            )
        return StarterEnd(starter_socket)

    def _start_service(self, name: str) -> None:
        self.workstation.start_module(
            "snakesim_hal.programs.service_program",
            name,
            str(self._config_path),
            "--router",
            ROUTER_FOR_WORKSTATION,
            log=self.folder / f"{name}.log",
        )

    def read_status(self) -> RobotStatus | None:
        """Return the newest status of the host, or None if it has not sent one yet."""
        self.host.receive()
        return self.host.status

    def is_armed(self) -> bool:
        """Return whether the newest status says that the robot is armed."""
        status = self.read_status()
        return status is not None and status.lifecycle == "armed"

    def wait_until(
        self,
        condition: Callable[[RobotStatus], bool],
        description: str,
        timeout_s: float = WAIT_TIMEOUT_S,
    ) -> float:
        """Wait until a status of the host meets a condition.

        Args:
            condition: Function that returns whether a status meets the condition.
            description: The condition in words, for the error message.
            timeout_s: Time after which the wait fails.

        Returns:
            The waiting time in s.

        Raises:
            AssertionError: No status met the condition in time. The message contains the ends of all logs.
        """
        start_s = time.monotonic()
        while True:
            status = self.read_status()
            if status is not None and condition(status):
                return time.monotonic() - start_s
            if time.monotonic() - start_s > timeout_s:
                reason = status.reason if status is not None else "the host has sent no status"
                raise AssertionError(
                    f"not within {timeout_s:g} s: {description}; {reason}\n{self._read_log_tails()}"
                )
            time.sleep(STATUS_POLL_S)

    def arm(self, timeout_s: float = WAIT_TIMEOUT_S) -> float:
        """Arm the robot as soon as the host is ready, after a reset if the host is in fault.

        Returns:
            The time until the robot is armed, in s.

        Raises:
            AssertionError: The robot was not armed in time.
        """
        start_s = time.monotonic()
        status = self.read_status()
        if status is not None and status.lifecycle == "fault":
            self._send_request("reset")
            self.wait_until(lambda status: status.lifecycle == "disarmed", "reset", timeout_s)
        while not self.is_armed():
            status = self.host.status
            reason = status.reason if status is not None else "the host has sent no status"
            assert time.monotonic() - start_s < timeout_s, f"not armed: {reason}"
            if status is not None and status.ready_to_arm:
                self._send_request("arm")
            time.sleep(ARM_REQUEST_INTERVAL_S)
        return time.monotonic() - start_s

    def disarm(self) -> None:
        """Disarm the robot, and wait until it is no longer armed."""
        self._send_request("disarm")
        self.wait_until(lambda status: status.lifecycle != "armed", "disarmed")

    def _send_request(self, action: Literal["arm", "disarm", "reset"]) -> None:
        description = self.host.description
        assert description is not None
        self.host.send_request(
            LifecycleRequest(
                action=action,
                requester="links",
                robot=description.robot,
                backend=description.backend,
                config_hash=description.config_hash,
                host=description.host,
            )
        )

    def _read_log_tails(self) -> str:
        return "\n".join(
            f"{log.name}: {log.read_text()[-LOG_TAIL_CHARACTERS:]}"
            for log in self.folder.glob("*.log")
        )


@contextmanager
def start_link_lab(folder: Path, *set_options: str) -> Iterator[LinkLab]:
    """Start a lab, and wait until its robot is ready to be armed. The lab ends with the context.

    Args:
        folder: Folder for the configuration, the record of the run, and the logs.
        set_options: Changes of the scenario, as `--set` takes them.
    """
    with ExitStack() as stack:
        link_lab = LinkLab(folder, stack, *set_options)
        link_lab.wait_until(lambda status: status.ready_to_arm, "ready to arm")
        yield link_lab
