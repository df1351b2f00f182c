"""A robot's host, a router and its services on three machines; armed and watched over the host's private channel.

The channel is a socket pair, so what happens to the network does not hide what the host does.
"""

import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

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
CHANGES = ("clock_mode=realtime", "duration_s=86400")
START_LIMIT_S = 60.0


class LinkLab:
    """Three machines, and what runs there."""

    def __init__(self, folder: Path, stack: ExitStack, *changes: str) -> None:
        self.folder = folder
        self.config: RunConfig = load_scenario(
            SCENARIO, [parse_set_option(text) for text in (*CHANGES, *changes)]
        ).config
        self._saved = folder / "config.json"
        write_config(self.config, self._saved)
        self.router_machine, self.robot, self.workstation = (
            NamespaceMachine(stack) for _ in range(3)
        )
        connect_by_cable(self.router_machine, self.robot, "robot", "10.77.1")
        self.link: RadioLink = stack.enter_context(
            connect_by_radio(self.router_machine, self.workstation, "workstation", "10.77.2")
        )
        os.environ["XDG_STATE_HOME"] = str(folder)
        self.start_router()
        self.host = self._start_host()
        for name in self.config.services:
            arguments = (
                "snakesim_hal.programs.service_program",
                name,
                str(self._saved),
                "--router",
                "tcp/10.77.2.1:7447",
            )
            self.workstation.start_module(*arguments, log=folder / f"{name}.log")

    def start_router(self) -> None:
        """A new router."""
        arguments = (
            "snakesim_hal.programs.router_program",
            str(self._saved),
            "--endpoint",
            "tcp/0.0.0.0:7447",
            "--insecure",
        )
        self._router = self.router_machine.start_module(
            *arguments, log=self.folder / "router.log", hurried=True
        )

    def record(self) -> Path:
        """Start a recorder beside the controller, that reads everything; its file."""
        out = self.folder / "recording.mcap"
        arguments = ("record", "--out", str(out), "--router", "tcp/10.77.2.1:7447")
        self.workstation.start(*SNAKESIM_COMMAND, *arguments, log=self.folder / "recorder.log")
        return out

    def kill_router(self) -> None:
        """At once."""
        self._router.send_signal(signal.SIGKILL)
        self._router.wait()

    def _start_host(self) -> StarterEnd:
        ours, its = socket_pair()
        with its:
            arguments = (
                "snakesim_hal.programs.host_program",
                str(self._saved),
                "--router",
                "tcp/10.77.1.1:7447",
            )
            out = ("--out", str(self.folder), "--parent-socket", str(its.fileno()))
            self.robot.start_module(
                *arguments, *out, log=self.folder / "host.log", inherits=[its.fileno()]
            )
        return StarterEnd(ours)

    @property
    def status(self) -> RobotStatus | None:
        """The host's newest."""
        self.host.receive()
        return self.host.status

    def until(
        self, condition: Callable[[RobotStatus], bool], what: str, limit_s: float = START_LIMIT_S
    ) -> float:
        """Wait for a status. Returns how long it took, in s."""
        began = time.monotonic()
        while (status := self.status) is None or not condition(status):
            if time.monotonic() - began > limit_s:
                logs = "\n".join(
                    f"{log.name}: {log.read_text()[-500:]}" for log in self.folder.glob("*.log")
                )
                raise AssertionError(
                    f"not within {limit_s:g} s: {what}; {status and status.reason}\n{logs}"
                )
            time.sleep(0.001)
        return time.monotonic() - began

    def arm(self, limit_s: float = START_LIMIT_S) -> float:
        """Reset if needed, and arm as soon as the host is ready. Returns after how many s."""
        began = time.monotonic()
        status = self.status
        if status is not None and status.lifecycle == "fault":
            self._ask("reset")
            self.until(lambda status: status.lifecycle == "disarmed", "reset", limit_s)
        while (status := self.status) is None or status.lifecycle != "armed":
            assert time.monotonic() - began < limit_s, f"not armed: {status and status.reason}"
            if status is not None and status.ready_to_arm:
                self._ask("arm")
            time.sleep(0.02)
        return time.monotonic() - began

    def disarm(self) -> None:
        """If it is armed."""
        self._ask("disarm")
        self.until(lambda status: status.lifecycle != "armed", "disarmed")

    def _ask(self, action: str) -> None:
        robot = self.host.description
        assert robot is not None
        named = {
            "robot": robot.robot,
            "backend": robot.backend,
            "config_hash": robot.config_hash,
            "host": robot.host,
        }
        self.host.send_request(LifecycleRequest(action=action, requester="links", **named))  # pyright: ignore[reportArgumentType]


@contextmanager
def lab(folder: Path, *changes: str) -> Iterator[LinkLab]:
    """A lab whose robot is ready to be armed. changes: of the scenario, as `--set` takes them."""
    with ExitStack() as stack:
        made = LinkLab(folder, stack, *changes)
        made.until(lambda status: status.ready_to_arm, "ready")
        yield made
