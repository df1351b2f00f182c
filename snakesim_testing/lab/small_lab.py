"""A lab on loopback: rendered and certified as a user would, its router the real program, its log kept."""

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

OWN, OTHER = "planar13", "second"
LIMIT_S = 20.0
COLOR = re.compile(r"\x1b\[[0-9;]*m")
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
    """The lab, and where its files are."""

    lab: Lab
    folder: Path
    log: Path

    def identity(self, common_name: str) -> Identity:
        """Whose certificate has this name."""
        return next(identity for identity in identities(self.lab) if identity.common_name == common_name)

    def who(self, role: Role, robot: str) -> Identity:
        """Who has a role of a robot."""
        return next(found for found in identities(self.lab) if (found.role, found.of) == (role, robot))

    def settings(self, identity: Identity, **more: Any) -> dict[str, Any]:
        """Of its session, for whole keys: without the namespace, and with what a test changes."""
        settings = session_settings(identity, self.lab)
        settings.pop("namespace", None)
        settings["connect"]["endpoints"] = self.lab.endpoints()[:1]
        settings["connect"]["timeout_ms"] = 3000
        return {**settings, **more}

    def session(self, identity: Identity, **more: Any) -> zenoh.Session:
        """A session of stock Zenoh."""
        return opened(self.settings(identity, **more))

    def said(self) -> list[str]:
        """The router's log."""
        return COLOR.sub("", self.log.read_text(errors="replace")).splitlines()


def opened(settings: dict[str, Any]) -> zenoh.Session:
    """A session of stock Zenoh with these settings. Raises ZError if no router accepts it."""
    zenoh.init_log_from_env_or("off")
    return zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))


@contextmanager
def small_lab(folder: Path) -> Iterator[SmallLab]:
    """Create the certificates and configuration files of a lab in a folder, and run its router meanwhile."""
    port = find_free_port()
    lab_file = folder / "lab.toml"
    lab_file.write_text(lab_text(folder, port))
    lab = load_lab(lab_file)
    write_certificates(lab, folder, folder / "authority")
    render(lab, folder)
    log = folder / "router.log"
    parent = os.getpid()
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
        wait_until(lambda: "router running" in log.read_text() or router.poll() is not None, "a router", LIMIT_S)
        assert router.poll() is None, log.read_text()
        yield SmallLab(lab, folder, log)
    finally:
        router.send_signal(signal.SIGTERM)
        router.wait(LIMIT_S)
