"""A lab of robots and workstations on loopback, for tests of access rights.

As a user would, `small_lab` writes a lab file, makes its certificates and configuration files, and starts its router.
"""

import json
import os
import re
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zenoh

from snakesim_hal.base.process import die_with_parent
from snakesim_hal.network.free_ports import find_free_port
from snakesim_hal.wire.roles import Role
from snakesim_operator.features.lab.certificates import write_certificates
from snakesim_operator.features.lab.identities import Identity, identities
from snakesim_operator.features.lab.lab_file import Lab, load_lab
from snakesim_operator.features.lab.render import render
from snakesim_operator.features.lab.zenoh_files import session_settings
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.runs.command import SNAKESIM, environment

# The two robots of the lab: tests take the role of a user of the first.
OWN = "planar13"
OTHER = "second"
LIMIT_S = 20.0  # for the start and for the end of the router
CONNECT_TIMEOUT_MS = 3000
COLOR = re.compile(r"\x1b\[[0-9;]*m")  # escape sequences in a terminal's output
MACHINES = ("hub", "robot1", "robot2", "ws1", "ws2", "laptop")


def lab_text(folder: Path, port: int) -> str:
    """Return the lab file of two robots, each with every role, behind one router.

    Args:
        folder: Where each machine has a folder of its own.
        port: Port of the router. The port after it is that of `spare`, a router that is never started.
    """
    machines = [f'[machines.{name}]\naddress = "127.0.0.1"\nfolder = "{folder}/{name}"' for name in MACHINES]
    routers = [
        f'[routers.main]\nmachine = "hub"\nport = {port}',
        f'[routers.spare]\nmachine = "hub"\nport = {port + 1}',
    ]
    robots = [
        f'[robots.{OWN}]\nmachine = "robot1"\nscenario = "triplet"\nbackend = "sim"\nfaults = true',
        f'[robots.{OTHER}]\nmachine = "robot2"\nscenario = "triplet"\nbackend = "sim"',
    ]
    roles: list[str] = []
    for robot, workstation in ((OWN, "ws1"), (OTHER, "ws2")):
        roles += [
            _role_text("gnc", workstation, robot),
            _role_text("recorder", workstation, robot),
            _role_text("operator", "laptop", robot),
            _role_text("viewer", "laptop", robot),
            _role_text("administrator", "hub", robot),
        ]
    roles.append(_role_text("operator", "laptop", "all"))
    return "\n\n".join(['name = "small lab"', *machines, *routers, *robots, *roles])


def _role_text(role: str, machine: str, robot: str) -> str:
    """Return the section of the lab file that gives a machine a role for a robot."""
    return f'[[roles]]\nmachine = "{machine}"\nrole = "{role}"\nrobot = "{robot}"'


@dataclass
class SmallLab:
    """A lab whose router runs, and where its files are."""

    lab: Lab  # content of the lab file
    folder: Path  # has a folder for each machine, with its certificates
    log: Path  # output of the router

    def identity(self, common_name: str) -> Identity:
        """Return the identity whose certificate has this common name."""
        return next(identity for identity in identities(self.lab) if identity.common_name == common_name)

    def who(self, role: Role, robot: str) -> Identity:
        """Return the first identity that has a role for a robot."""
        return next(found for found in identities(self.lab) if found.role == role and found.of == robot)

    def settings(self, identity: Identity, **more: Any) -> dict[str, Any]:
        """Return the Zenoh configuration of a session with the certificate of an identity.

        The session has no namespace, so that a test can use the full key of any robot.

        Args:
            identity: Whose certificate authenticates the session.
            more: Sections of the configuration that replace those of the identity.
        """
        settings = session_settings(identity, self.lab)
        settings.pop("namespace", None)
        running_router = self.lab.endpoints()[:1]  # the other router never runs
        settings["connect"]["endpoints"] = running_router
        settings["connect"]["timeout_ms"] = CONNECT_TIMEOUT_MS
        return {**settings, **more}

    def session(self, identity: Identity, **more: Any) -> zenoh.Session:
        """Open a plain Zenoh session with the certificate of an identity. Raises ZError if no router accepts it."""
        return opened(self.settings(identity, **more))

    def printed(self) -> list[str]:
        """Return the lines of the router's log, without colors."""
        return COLOR.sub("", self.log.read_text(errors="replace")).splitlines()


def opened(settings: dict[str, Any]) -> zenoh.Session:
    """Open a plain Zenoh session with a configuration. Raises ZError if no router accepts it."""
    zenoh.init_log_from_env_or("off")
    return zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))


@contextmanager
def small_lab(folder: Path) -> Iterator[SmallLab]:
    """Create a lab in a folder, and run its router until the end of the context.

    The lab has two robots and the machines in MACHINES, all on loopback; see `lab_text`. Only the router runs: tests
    open the sessions of the machines by themselves.

    Args:
        folder: An empty folder, which gets the lab file, certificates, configuration files and the router's log.

    Yields:
        The lab, when its router accepts connections.
    """
    port = find_free_port()
    lab_file = folder / "lab.toml"
    lab_file.write_text(lab_text(folder, port))
    lab = load_lab(lab_file)
    write_certificates(lab, folder, folder / "authority")
    render(lab, folder)
    log = folder / "router.log"
    parent = os.getpid()  # the router ends with this process, even if it is killed
    with log.open("w") as out:
        router = subprocess.Popen(
            [*SNAKESIM, "start", "router", str(folder / "hub" / "router.main.json5")],
            cwd=folder,
            env=environment(folder),
            stdout=out,
            stderr=subprocess.STDOUT,
            preexec_fn=lambda: die_with_parent(parent),
        )
    try:
        # A router that has ended will never run, so its end also ends the wait, and fails here.
        wait_until(lambda: "router running" in log.read_text() or router.poll() is not None, "a router", LIMIT_S)
        has_ended = router.poll() is not None
        assert not has_ended, log.read_text()
        yield SmallLab(lab, folder, log)
    finally:
        router.send_signal(signal.SIGTERM)
        router.wait(LIMIT_S)
