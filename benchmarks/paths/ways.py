"""Ways from a robot to its controller, through the routers of a lab. Each machine is a network namespace."""

import json
import subprocess
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from snakesim_testing.lab.machines import NamespaceMachine, connect_by_cable

PORT = 7447
QUIET = {"multicast": {"enabled": False}, "gossip": {"enabled": False}}


@dataclass
class ConnectionWay:
    """How host and controller reach each other, and two raw sessions on the same machines."""

    name: str
    robot: NamespaceMachine
    workstation: NamespaceMachine
    host: list[str]  # arguments
    service: list[str]
    robot_file: Path
    workstation_file: Path
    routers: list[tuple[NamespaceMachine, Path]] = field(default_factory=list)


class CabledMachines:
    """The machines, cabled, and files for each way."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self.folder = folder
        self.robot, self.first, self.second, self.workstation = (
            NamespaceMachine(stack) for _ in range(4)
        )
        connect_by_cable(self.first, self.robot, "robot", "10.78.1")
        connect_by_cable(self.first, self.workstation, "desk", "10.78.2")
        connect_by_cable(self.first, self.second, "trunk", "10.78.3")
        connect_by_cable(self.second, self.workstation, "desk2", "10.78.4")
        connect_by_cable(self.robot, self.workstation, "direct", "10.78.5")

    def ways(self) -> list[ConnectionWay]:
        """All of them."""
        two = [
            (self.first, self._file("first", "router", listen=["tcp/0.0.0.0:7447"])),
            (
                self.second,
                self._file(
                    "second", "router", listen=["tcp/0.0.0.0:7447"], connect=["tcp/10.78.3.1:7447"]
                ),
            ),
        ]
        tls = [
            (
                self.first,
                self._file(
                    "tls-router", "router", listen=["tls/0.0.0.0:7447"], tls=self._certificates()
                ),
            )
        ]
        return [
            self._direct(),
            self._by("one router", two[:1], "tcp/10.78.1.1:7447", "tcp/10.78.2.1:7447"),
            self._by(
                "one router, mTLS",
                tls,
                "tls/10.78.1.1:7447",
                "tls/10.78.2.1:7447",
                self._certificates(),
            ),
            self._by("two routers", two, "tcp/10.78.1.1:7447", "tcp/10.78.4.1:7447"),
        ]

    def one_router(self) -> ConnectionWay:
        """Host and controller at one router."""
        return self.ways()[1]

    def _direct(self) -> ConnectionWay:
        endpoint = "tcp/10.78.5.1:7447"
        own = self._file("direct-robot", "router", listen=[endpoint])
        other = self._file("direct-desk", "client", connect=[endpoint])
        host = ["--endpoint", endpoint, "--insecure"]
        return ConnectionWay(
            "direct", self.robot, self.workstation, host, ["--endpoint", endpoint], own, other
        )

    def _by(
        self,
        name: str,
        routers: list[tuple[NamespaceMachine, Path]],
        robot: str,
        desk: str,
        tls: dict[str, Any] | None = None,
    ) -> ConnectionWay:
        stem = name.replace(" ", "-").replace(",", "")
        own = self._file(f"{stem}-robot", "client", connect=[robot], tls=tls)
        other = self._file(f"{stem}-desk", "client", connect=[desk], tls=tls)
        host, service = ["--session", str(own)], ["--session", str(other)]
        return ConnectionWay(name, self.robot, self.workstation, host, service, own, other, routers)

    def _file(
        self, stem: str, mode: str, *, tls: dict[str, Any] | None = None, **ends: list[str]
    ) -> Path:
        path = self.folder / f"{stem}.json5"
        settings: dict[str, Any] = {"mode": mode, "scouting": QUIET}
        settings |= {verb: {"endpoints": endpoints} for verb, endpoints in ends.items()}
        if mode == "client":
            settings["connect"]["timeout_ms"] = 30000
        if tls is not None:
            settings["transport"] = {"link": {"tls": tls}}
        path.write_text(json.dumps(settings))
        return path

    def _certificates(self) -> dict[str, Any]:
        """One authority, and one certificate for all: what a handshake and a record cost does not depend on it."""
        authority, key, leaf = (self.folder / name for name in ("ca.pem", "key.pem", "leaf.pem"))
        if not leaf.is_file():
            names = "subjectAltName=IP:10.78.1.1,IP:10.78.2.1"
            made = [
                "-newkey",
                "ec",
                "-pkeyopt",
                "ec_paramgen_curve:prime256v1",
                "-nodes",
                "-days",
                "2",
            ]
            own = [
                "-x509",
                "-subj",
                "/CN=lab",
                "-keyout",
                self.folder / "ca.key",
                "-out",
                authority,
            ]
            subprocess.run(["openssl", "req", *made, *own], check=True, capture_output=True)
            signed = [
                "-x509",
                "-CA",
                authority,
                "-CAkey",
                self.folder / "ca.key",
                "-subj",
                "/CN=all",
                "-addext",
                names,
            ]
            signed += [
                "-addext",
                "basicConstraints=critical,CA:FALSE",
                "-keyout",
                key,
                "-out",
                leaf,
            ]
            subprocess.run(["openssl", "req", *made, *signed], check=True, capture_output=True)
        return {
            "root_ca_certificate": str(authority),
            "enable_mtls": True,
            **{f"{verb}_certificate": str(leaf) for verb in ("listen", "connect")},
            **{f"{verb}_private_key": str(key) for verb in ("listen", "connect")},
        }
