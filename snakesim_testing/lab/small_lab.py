"""A lab of robots and workstations on loopback, for tests of access rights.

As a user would, `running_test_lab` writes a lab file, makes its certificates and configuration files, and starts its
router.
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

from snakesim_hal.base.process import set_parent_death_signal
from snakesim_hal.network.free_ports import find_free_port
from snakesim_hal.wire.roles import Role
from snakesim_operator.features.lab.certificates import write_certificates
from snakesim_operator.features.lab.identities import CertificateIdentity, iterate_identities
from snakesim_operator.features.lab.lab_file import LabPlan, load_lab
from snakesim_operator.features.lab.render import write_lab_files
from snakesim_operator.features.lab.zenoh_files import make_session_settings
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.runs.command import SNAKESIM_COMMAND, make_environment

# The two robots of the lab: tests take the role of a user of the first.
OWN_ROBOT = "planar13"
OTHER_ROBOT = "second"
ROUTER_TIMEOUT_S = 20.0  # for the start and for the end of the router
CONNECT_TIMEOUT_MS = 3000
COLOR = re.compile(r"\x1b\[[0-9;]*m")  # escape sequences in a terminal's output
MACHINES = ("hub", "robot1", "robot2", "ws1", "ws2", "laptop")


def format_lab_file(folder: Path, port: int) -> str:
    """Return the text of a lab file with two robots behind one router, and every role for each of them.

    Args:
        folder: Folder that gets a subfolder for each machine.
        port: Port of the router `main`. The next port is that of the router `spare`, which is never started.
    """
    machines = [
        f'[machines.{name}]\naddress = "127.0.0.1"\nfolder = "{folder}/{name}"' for name in MACHINES
    ]
    routers = [
        f'[routers.main]\nmachine = "hub"\nport = {port}',
        f'[routers.spare]\nmachine = "hub"\nport = {port + 1}',
    ]
    robots = [
        f'[robots.{OWN_ROBOT}]\nmachine = "robot1"\nscenario = "triplet"\nbackend = "sim"\nfaults = true',
        f'[robots.{OTHER_ROBOT}]\nmachine = "robot2"\nscenario = "triplet"\nbackend = "sim"',
    ]
    roles: list[str] = []
    for robot, workstation in ((OWN_ROBOT, "ws1"), (OTHER_ROBOT, "ws2")):
        roles += [
            _format_role_section("gnc", workstation, robot),
            _format_role_section("recorder", workstation, robot),
            _format_role_section("operator", "laptop", robot),
            _format_role_section("viewer", "laptop", robot),
            _format_role_section("administrator", "hub", robot),
        ]
    roles.append(_format_role_section("operator", "laptop", "all"))
    return "\n\n".join(['name = "small lab"', *machines, *routers, *robots, *roles])


def _format_role_section(role: str, machine: str, robot: str) -> str:
    """Return the section of the lab file that gives a machine a role for a robot."""
    return f'[[roles]]\nmachine = "{machine}"\nrole = "{role}"\nrobot = "{robot}"'


@dataclass
class RunningLab:
    """A lab whose router is running, with the paths of its files."""

    lab: LabPlan  # content of the lab file
    folder: Path  # has a folder for each machine, with its certificates
    log: Path  # output of the router

    def find_identity_by_name(self, common_name: str) -> CertificateIdentity:
        """Return the identity whose certificate has this common name."""
        return next(
            identity
            for identity in iterate_identities(self.lab)
            if identity.common_name == common_name
        )

    def find_identity_by_role(self, role: Role, robot: str) -> CertificateIdentity:
        """Return the first identity that has a role for a robot."""
        return next(
            found
            for found in iterate_identities(self.lab)
            if found.role == role and found.subject == robot
        )

    def make_session_settings(self, identity: CertificateIdentity, **more: Any) -> dict[str, Any]:
        """Return the Zenoh configuration of a session with the certificate of an identity.

        The session has no namespace, so that a test can use the full key of any robot.

        Args:
            identity: Identity whose certificate authenticates the session.
            more: Sections of the configuration that replace those of the identity.
        """
        settings = make_session_settings(identity, self.lab)
        settings.pop("namespace", None)
        running_router = self.lab.list_endpoints()[:1]  # the other router never runs
        settings["connect"]["endpoints"] = running_router
        settings["connect"]["timeout_ms"] = CONNECT_TIMEOUT_MS
        return {**settings, **more}

    def open_session(self, identity: CertificateIdentity, **more: Any) -> zenoh.Session:
        """Open a plain Zenoh session with the certificate of an identity. Raises ZError if no router accepts it."""
        return open_zenoh_session(self.make_session_settings(identity, **more))

    def read_router_log(self) -> list[str]:
        """Return the lines of the router's log, without colors."""
        return COLOR.sub("", self.log.read_text(errors="replace")).splitlines()


def open_zenoh_session(settings: dict[str, Any]) -> zenoh.Session:
    """Open a plain Zenoh session with a configuration. Raises ZError if no router accepts it."""
    zenoh.init_log_from_env_or("off")
    return zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))


@contextmanager
def running_test_lab(folder: Path) -> Iterator[RunningLab]:
    """Create the files of a lab in a folder, and run its router until the end of the context.

    A lab is a network of robots and machines, described by a lab file. This one has two robots and the machines in
    MACHINES, all on loopback; see `format_lab_file`. Only the router runs: tests open the sessions of the machines
    themselves.

    Args:
        folder: An empty folder, which gets the lab file, certificates, configuration files and the log of the router.

    Yields:
        The lab, once its router accepts connections.
    """
    port = find_free_port()
    lab_path = folder / "lab.toml"
    lab_path.write_text(format_lab_file(folder, port))
    lab = load_lab(lab_path)
    write_certificates(lab, folder, folder / "authority")
    write_lab_files(lab, folder)
    log_path = folder / "router.log"
    parent = os.getpid()  # the router ends with this process, even if it is killed
    with log_path.open("w") as log_file:
        router = subprocess.Popen(
            [*SNAKESIM_COMMAND, "start", "router", str(folder / "hub" / "router.main.json5")],
            cwd=folder,
            env=make_environment(folder),
            stdout=log_file,
            stderr=subprocess.STDOUT,
            preexec_fn=lambda: set_parent_death_signal(parent),
        )
    try:
        # A router that has ended will never run, so its end also ends the wait, and fails here.
        wait_until(
            lambda: "router running" in log_path.read_text() or router.poll() is not None,
            "a router",
            ROUTER_TIMEOUT_S,
        )
        has_ended = router.poll() is not None
        assert not has_ended, log_path.read_text()
        yield RunningLab(lab, folder, log_path)
    finally:
        router.send_signal(signal.SIGTERM)
        router.wait(ROUTER_TIMEOUT_S)
