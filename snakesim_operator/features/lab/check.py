"""`snakesim deploy check`: checks that a running lab is as its lab file says.

It connects as each identity in turn, with the certificates in the output folder, and moves nothing: it subscribes,
looks for liveliness tokens, and asks with empty queries, which a host refuses.
"""

import json
import socket
import ssl
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from cryptography import x509

from snakesim_hal.base.errors import ConfigError, NotConnectedError
from snakesim_hal.base.terminal import Say, say
from snakesim_hal.model.what_moves import describe_what_moves
from snakesim_hal.network.private_keys import readable_by_all
from snakesim_hal.network.probe import open_probe
from snakesim_hal.network.process_entries import HOST, differences
from snakesim_hal.network.session import Link, Session, open_session
from snakesim_hal.network.session_file import read_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Description, Process, Status
from snakesim_hal.wire.roles import RECORDER, TABLE, Role
from snakesim_operator.features.lab.certificates import RENEW_AT, read_certificate
from snakesim_operator.features.lab.drive_buses import SIMULATOR, is_to_be_real
from snakesim_operator.features.lab.identities import Identity, identities
from snakesim_operator.features.lab.lab_file import Lab
from snakesim_operator.features.lab.lab_robot import Robot
from snakesim_operator.features.lab.zenoh_files import session_settings, tls_files

CONNECT_MS = 2000
LISTEN_S = 1.0
CLOCK_LIMIT_S = 0.5  # by which a clock may differ; Zenoh's routers restamp what is further in the future
ASKABLE = (keys.LEASE, keys.LIFECYCLE)  # an empty query there has no effect
# Who is behind a key that is published all the time.
WRITERS = {
    keys.CLOCK: HOST,
    keys.WORLD: "guidance",
    keys.TRAJECTORY: "navigation",
    keys.CONTROL_STATE: "control",
}


@dataclass
class Findings:
    """What is said, and what of it is wrong."""

    say: Say
    wrong: int = 0

    def passed(self, text: str) -> None:
        """As it should be."""
        self.say(f"  {text}")

    def failed(self, text: str) -> None:
        """Not as it should be."""
        self.wrong += 1
        self.say(f"! {text}")


def check(lab: Lab, folder: Path, say: Say = say) -> int:
    """Check everything. folder: of `deploy certs`. Returns 0 when all is as the lab file says, 1 otherwise."""
    found = Findings(say)
    say("certificates")
    for identity in identities(lab):
        _check_certificate(identity, folder, found)
    say("routers")
    if not [name for name in lab.file.routers if _check_router(name, lab, folder, found)]:
        say("no router can be reached, and so neither robots nor roles can be looked at")
        return 1
    for robot in lab.file.robots:
        say(f"robot {robot}")
        _check_robot(robot, lab, folder, found)
    say("roles: what each may ask")
    for identity in identities(lab):
        if identity.role is not None:
            _check_role(identity, lab, folder, found)
    say("all is as it should be" if not found.wrong else f"{found.wrong} marked with ! need a look")
    return 1 if found.wrong else 0


def _check_certificate(identity: Identity, folder: Path, found: Findings) -> None:
    at = _tls(identity, folder) / f"{identity.label}.pem"
    try:
        certificate = read_certificate(at)
    except ConfigError as error:
        found.failed(f"{identity.common_name}: {error}")
        return
    _check_end(identity.common_name, certificate, "run `snakesim deploy certs` and install it", found)
    if wrong := readable_by_all(at.with_suffix(".key")):
        found.failed(f"{identity.common_name}: {wrong}, and renew it with `snakesim deploy certs --rotate`")


def _check_end(what: str, certificate: x509.Certificate, remedy: str, found: Findings) -> None:
    end = certificate.not_valid_after_utc
    left, life = end - datetime.now(UTC), end - certificate.not_valid_before_utc
    text = f"{what}: ends {end:%Y-%m-%d %H:%M} UTC, in {left.total_seconds() / 86400:.1f} days"
    if left > life * RENEW_AT:
        found.passed(text)
    else:
        found.failed(f"{text}; {remedy}")


def _check_router(name: str, lab: Lab, folder: Path, found: Findings) -> bool:
    """Whether it accepts only clients with a certificate, and which one it shows itself. False: not reached."""
    endpoint = lab.endpoint(name)
    identity = Identity(lab.file.routers[name].machine, None, name)
    try:
        _plain_connection(endpoint).close()
    except OSError as error:
        found.failed(
            f"{name}: nothing answers on {endpoint}: {error}; start it on {identity.machine}, or open the port"
        )
        return False
    anybody = next((other for other in identities(lab) if other.role is not None), None)
    if anybody is None:
        return True
    settings = _settings(anybody, lab, folder, [endpoint])
    try:
        with open_probe(json.dumps(settings)) as probe:
            found.passed(f"{name}: {endpoint}, round trip {1e3 * probe.round_trip_s():.2f} ms")
    except NotConnectedError as error:
        found.failed(f"{name}: {endpoint} lets {anybody.common_name} not in: {error}")
        return True
    tls = settings["transport"]["link"]["tls"]
    shown = _shown_certificate(endpoint, tls)
    kept = read_certificate(_tls(identity, folder) / f"{identity.label}.pem")
    if shown.serial_number != kept.serial_number:
        _check_end(f"{name} shows an earlier certificate", shown, f"restart it on {identity.machine}", found)
    settings["transport"]["link"]["tls"] = {"root_ca_certificate": tls["root_ca_certificate"]}
    try:
        with open_probe(json.dumps(settings)):
            found.failed(f"{name}: accepts clients without a certificate; it does not run with the rendered file")
    except NotConnectedError:
        found.passed(f"{name}: refuses clients without a certificate")
    return True


def _plain_connection(endpoint: str) -> socket.socket:
    host, _, port = endpoint.removeprefix("tls/").rpartition(":")
    return socket.create_connection((host.strip("[]"), int(port)), timeout=CONNECT_MS / 1000)


def _shown_certificate(endpoint: str, tls: dict[str, Any]) -> x509.Certificate:
    """What a router shows to who connects."""
    host = endpoint.removeprefix("tls/").rpartition(":")[0].strip("[]")
    context = ssl.create_default_context(cafile=tls["root_ca_certificate"])
    context.load_cert_chain(tls["connect_certificate"], tls["connect_private_key"])
    with _plain_connection(endpoint) as plain, context.wrap_socket(plain, server_hostname=host) as wrapped:
        return x509.load_der_x509_certificate(wrapped.getpeercert(binary_form=True) or b"")


def _check_robot(robot: str, lab: Lab, folder: Path, found: Findings) -> None:
    """Its processes: where they run, which version, what is set up differently, and their clocks."""
    held = [identity for identity in identities(lab) if robot in identity.robots(lab)]
    watcher = max(held, key=lambda identity: list(Role).index(identity.role or Role.ROBOT))
    try:
        with _session(watcher, robot, lab, folder) as session:
            status = session.latest(keys.STATUS, Status, LISTEN_S)
            description = session.latest(keys.DESCRIPTION, Description, LISTEN_S) if status is not None else None
            live = session.present(keys.PROCESS_ALL)
            reader = session.latched_reader(keys.PROCESS_ALL, Process)
            with open_probe(json.dumps({**_settings(watcher, lab, folder), "namespace": robot})) as probe:
                ahead = probe.clock_offsets_s(list(WRITERS), LISTEN_S)
            entries = reader.drain()
    except NotConnectedError as error:
        found.failed(f"cannot be looked at as {watcher.common_name}: {error}")
        return
    if status is not None:
        found.passed(f"{status.lifecycle} - {status.why}")
        check_what_moves(lab.file.robots[robot], description, found)
    host = next((entry for entry in entries if entry.name == HOST), None)
    expected = {HOST: lab.file.robots[robot].machine}
    for identity in held:
        expected |= dict.fromkeys(identity.services, identity.machine)
        expected |= {RECORDER: identity.machine} if identity.role is Role.RECORDER else {}
    for name, machine in expected.items():
        running = [entry for entry in entries if entry.name == name]
        if not running or not any(keys.service_of(key).rpartition("-")[0] == name for key in live):
            found.failed(f"{name}: not running; it belongs on {machine}")
        for entry in running:
            _check_process(entry, host, ahead, found)


def check_what_moves(robot: Robot, description: Description | None, found: Findings) -> None:
    """A robot that the lab file names a bus for must not be emulated, and the other way round."""
    words = describe_what_moves(description)
    if description is None:
        found.failed(words)
    elif is_to_be_real(robot) and description.emulated:
        found.failed(f"{words}, but the lab file names its bus; render again, install, and restart the host")
    elif (robot.backend == SIMULATOR or robot.emulated) and not description.emulated:
        found.failed(f"{words}, but by the lab file nothing real is to move; see which host runs")
    else:
        found.passed(words)


def _check_process(entry: Process, host: Process | None, ahead: dict[str, float], found: Findings) -> None:
    found.passed(f"{entry.name}: on {entry.machine}, process {entry.pid}, snakesim {entry.version}")
    if host is not None and entry.version != host.version:
        found.failed(f"{entry.name}: snakesim {entry.version}, but the host has {host.version}")
    for difference in differences(entry, host) if host is not None else ():
        found.failed(f"{entry.name}: {difference}")
    for key, writer in WRITERS.items():
        if writer == entry.name and key in ahead:
            tell = found.passed if abs(ahead[key]) < CLOCK_LIMIT_S else found.failed
            tell(f"{entry.name}: clock {ahead[key]:+.3f} s against this computer's")


def _check_role(identity: Identity, lab: Lab, folder: Path, found: Findings) -> None:
    """Whether it gets in, and whether the routers answer as the table of roles says."""
    try:
        with open_probe(json.dumps(_settings(identity, lab, folder))) as probe:
            trip_ms = 1e3 * probe.round_trip_s()
            for robot in lab.file.robots:
                own = robot in identity.robots(lab)
                for line in (line for line in TABLE if line.key in ASKABLE):
                    granted = own and "ask" in line.acts(identity.role or Role.VIEWER)
                    answers = probe.answers(f"{robot}/{line.key}")
                    query = f"{identity.common_name}: {robot}/{line.key}"
                    if answers > granted:
                        found.failed(f"{query} answers, though the role may not ask; the router has other rules")
                    elif answers < granted:
                        found.failed(f"{query} does not answer, though the role may ask; no host, or other rules")
            found.passed(f"{identity.common_name}: round trip {trip_ms:.2f} ms")
    except NotConnectedError as error:
        found.failed(f"{identity.common_name}: not let in: {error}")


@contextmanager
def _session(identity: Identity, robot: str, lab: Lab, folder: Path) -> Iterator[Session]:
    """A session of ours as one identity."""
    with TemporaryDirectory() as scratch:
        path = Path(scratch) / "session.json5"
        path.write_text(json.dumps(_settings(identity, lab, folder)), encoding="utf-8")
        with open_session(Link.of_file(read_session(path), robot), CONNECT_MS / 1000) as session:
            yield session


def _settings(identity: Identity, lab: Lab, folder: Path, endpoints: list[str] | None = None) -> dict[str, Any]:
    """Of an identity's session, for whole keys, with the certificate that lies here."""
    settings = session_settings(identity, lab)
    settings.pop("namespace", None)
    settings["connect"] |= {"timeout_ms": CONNECT_MS, "endpoints": endpoints or lab.endpoints()}
    settings["transport"]["link"]["tls"] |= tls_files(identity, str(_tls(identity, folder)), "connect")
    return settings


def _tls(identity: Identity, folder: Path) -> Path:
    return folder.absolute() / identity.machine / "tls"
