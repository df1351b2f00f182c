"""Ways from a robot to its controller through the routers of a lab, whose machines are network namespaces."""

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
    """A way between host and controller, and the session files of two raw Zenoh sessions on the same machines."""

    name: str
    robot: NamespaceMachine
    workstation: NamespaceMachine
    host: list[str]  # arguments of the host program
    service: list[str]  # arguments of a service program
    robot_file: Path
    workstation_file: Path
    routers: list[tuple[NamespaceMachine, Path]] = field(default_factory=list)


class CabledMachines:
    """Four machines and the cables between them, with session files for each way."""

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

    def list_ways(self) -> list[ConnectionWay]:
        """Return all ways between robot and workstation, the direct one first."""
        two = [
            (self.first, self._write_session_file("first", "router", listen=["tcp/0.0.0.0:7447"])),
            (
                self.second,
                self._write_session_file(
                    "second", "router", listen=["tcp/0.0.0.0:7447"], connect=["tcp/10.78.3.1:7447"]
                ),
            ),
        ]
        tls = [
            (
                self.first,
                self._write_session_file(
                    "tls-router", "router", listen=["tls/0.0.0.0:7447"], tls=self._certificates()
                ),
            )
        ]
        return [
            self._make_direct_way(),
            self._make_way_by_routers(
                "one router", two[:1], "tcp/10.78.1.1:7447", "tcp/10.78.2.1:7447"
            ),
            self._make_way_by_routers(
                "one router, mTLS",
                tls,
                "tls/10.78.1.1:7447",
                "tls/10.78.2.1:7447",
                self._certificates(),
            ),
            self._make_way_by_routers(
                "two routers", two, "tcp/10.78.1.1:7447", "tcp/10.78.4.1:7447"
            ),
        ]

    def find_way_by_one_router(self) -> ConnectionWay:
        """Return the way on which host and controller connect to the same router."""
        return self.list_ways()[1]

    def _make_direct_way(self) -> ConnectionWay:
        endpoint = "tcp/10.78.5.1:7447"
        robot_file = self._write_session_file("direct-robot", "router", listen=[endpoint])
        workstation_file = self._write_session_file("direct-desk", "client", connect=[endpoint])
        host = ["--endpoint", endpoint, "--insecure"]
        return ConnectionWay(
            "direct",
            self.robot,
            self.workstation,
            host=host,
            service=["--endpoint", endpoint],
            robot_file=robot_file,
            workstation_file=workstation_file,
        )

    def _make_way_by_routers(
        self,
        name: str,
        routers: list[tuple[NamespaceMachine, Path]],
        robot: str,
        desk: str,
        tls: dict[str, Any] | None = None,
    ) -> ConnectionWay:
        stem = name.replace(" ", "-").replace(",", "")
        robot_file = self._write_session_file(f"{stem}-robot", "client", connect=[robot], tls=tls)
        workstation_file = self._write_session_file(
            f"{stem}-desk", "client", connect=[desk], tls=tls
        )
        return ConnectionWay(
            name,
            self.robot,
            self.workstation,
            host=["--session", str(robot_file)],
            service=["--session", str(workstation_file)],
            robot_file=robot_file,
            workstation_file=workstation_file,
            routers=routers,
        )

    def _write_session_file(
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
        """Create a certificate authority, and one certificate that all processes use.

        The cost of a handshake or a record does not depend on whose certificate it is.
        """
        authority, key, leaf = (self.folder / name for name in ("ca.pem", "key.pem", "leaf.pem"))
        if not leaf.is_file():
            names = "subjectAltName=IP:10.78.1.1,IP:10.78.2.1"
            key_options = [
                "-newkey",
                "ec",
                "-pkeyopt",
                "ec_paramgen_curve:prime256v1",
                "-nodes",
                "-days",
                "2",
            ]
            authority_options = [
                "-x509",
                "-subj",
                "/CN=lab",
                "-keyout",
                self.folder / "ca.key",
                "-out",
                authority,
            ]
            subprocess.run(
                ["openssl", "req", *key_options, *authority_options],
                check=True,
                capture_output=True,
            )
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
            subprocess.run(
                ["openssl", "req", *key_options, *signed], check=True, capture_output=True
            )
        return {
            "root_ca_certificate": str(authority),
            "enable_mtls": True,
            **{f"{verb}_certificate": str(leaf) for verb in ("listen", "connect")},
            **{f"{verb}_private_key": str(key) for verb in ("listen", "connect")},
        }
