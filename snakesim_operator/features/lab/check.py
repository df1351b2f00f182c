"""Checks for `snakesim lab check` that a running lab matches its lab file.

The check connects as each identity in turn, with the certificates in the output folder, and moves nothing: it
subscribes, looks for liveliness tokens, and sends empty queries, which a host refuses.
"""

import json
import socket
import ssl
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from cryptography import x509

from snakesim_hal.base.errors import ConfigError, NotConnectedError
from snakesim_hal.base.terminal import PrintLine, discard_line, print_json, print_line
from snakesim_hal.model.what_moves import describe_what_moves
from snakesim_hal.network.private_keys import check_permissions
from snakesim_hal.network.probe import open_probe
from snakesim_hal.network.process_entries import HOST, describe_differences
from snakesim_hal.network.session import ConnectionSettings, Session, open_session
from snakesim_hal.network.session_file import read_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import ProcessInfo, RobotDescription, RobotStatus
from snakesim_hal.wire.roles import ACCESS_RULES, RECORDER, Role
from snakesim_operator.features.lab.certificates import RENEWAL_FRACTION, read_certificate
from snakesim_operator.features.lab.drive_buses import SIMULATOR_BACKEND, has_real_drives
from snakesim_operator.features.lab.identities import CertificateIdentity, iterate_identities
from snakesim_operator.features.lab.lab_file import LabPlan
from snakesim_operator.features.lab.lab_robot import LabRobot
from snakesim_operator.features.lab.zenoh_files import make_session_settings, make_tls_paths

CONNECT_TIMEOUT_MS = 2000
LISTEN_S = 1.0
# By which a clock may differ; Zenoh's routers restamp what is further in the future.
MAX_CLOCK_OFFSET_S = 0.5
QUERIED_KEYS = (keys.LEASE, keys.LIFECYCLE)  # an empty query there has no effect
WRITER_BY_KEY = {  # the process that publishes at a key all the time
    keys.CLOCK: HOST,
    keys.WORLD: "guidance",
    keys.TRAJECTORY: "navigation",
    keys.CONTROL_STATE: "control",
}


@dataclass
class CheckResults:
    """Prints the results of the checks, keeps them, and counts the failures."""

    print_text: PrintLine
    wrong: int = 0
    results: list[dict[str, Any]] = field(default_factory=list[dict[str, Any]])

    def report_passed(self, text: str) -> None:
        """Print a result that is as it should be."""
        self.results.append({"passed": True, "text": text})
        self.print_text(f"  {text}")

    def report_failed(self, text: str) -> None:
        """Print a result that is wrong, and count it."""
        self.wrong += 1
        self.results.append({"passed": False, "text": text})
        self.print_text(f"! {text}")


def check_running_lab(
    lab: LabPlan, folder: Path, print_text: PrintLine = print_line, *, as_json: bool = False
) -> int:
    """Check certificates, routers, robots and roles of a running lab, and print the results.

    Args:
        lab: The lab.
        folder: The output folder of `lab certs`.
        print_text: Prints a line.
        as_json: Whether to print one JSON object at the end instead of lines.

    Returns:
        The exit code: 0 if all matches the lab file, 1 otherwise.
    """
    if as_json:
        results = CheckResults(discard_line)
        exit_code = _run_all_checks(lab, folder, results)
        print_json({"ok": exit_code == 0, "results": results.results}, print_text)
        return exit_code
    return _run_all_checks(lab, folder, CheckResults(print_text))


def _run_all_checks(lab: LabPlan, folder: Path, results: CheckResults) -> int:
    """Check certificates, then routers, then robots and roles, which are reached through the routers.

    Args:
        lab: The lab.
        folder: The output folder of `lab certs`.
        results: Collects and prints the result of each check.

    Returns:
        The exit code: 0 if all matches the lab file, 1 otherwise.
    """
    print_text = results.print_text
    print_text("certificates")
    for identity in iterate_identities(lab):
        _check_certificate(identity, folder, results)
    print_text("routers")
    reachable_routers = [
        name for name in lab.file.routers if _check_router(name, lab, folder, results)
    ]
    if not reachable_routers:
        results.results.append({"passed": False, "text": "no router can be reached"})
        print_text("no router can be reached, and so neither robots nor roles can be looked at")
        return 1
    for robot in lab.file.robots:
        print_text(f"robot {robot}")
        _check_robot(robot, lab, folder, results)
    print_text("roles: what each may request")
    for identity in iterate_identities(lab):
        if identity.role is not None:
            _check_role_permissions(identity, identity.role, lab, folder, results)
    if results.wrong:
        print_text(f"{results.wrong} marked with ! need a look")
        return 1
    print_text("all is as it should be")
    return 0


def _check_certificate(identity: CertificateIdentity, folder: Path, results: CheckResults) -> None:
    """Check that the certificate of an identity is there and valid, and that only its owner can read its key."""
    path = _get_certificate_path(identity, folder)
    try:
        certificate = read_certificate(path)
    except ConfigError as error:
        results.report_failed(f"{identity.common_name}: {error}")
        return
    _check_expiry(
        identity.common_name, certificate, "run `snakesim lab certs` and install it", results
    )
    warning = check_permissions(path.with_suffix(".key"))
    if warning:
        results.report_failed(
            f"{identity.common_name}: {warning}, and renew it with `snakesim lab certs --rotate`"
        )


def _check_expiry(
    name: str, certificate: x509.Certificate, remedy: str, results: CheckResults
) -> None:
    """Check that a certificate is not due for renewal, and report when it ends."""
    end = certificate.not_valid_after_utc
    lifetime = end - certificate.not_valid_before_utc
    remaining = end - datetime.now(UTC)
    text = f"{name}: ends {end:%Y-%m-%d %H:%M} UTC, in {remaining.total_seconds() / 86400:.1f} days"
    if remaining > lifetime * RENEWAL_FRACTION:
        results.report_passed(text)
    else:
        results.report_failed(f"{text}; {remedy}")


def _check_router(name: str, lab: LabPlan, folder: Path, results: CheckResults) -> bool:
    """Check that a router accepts a client of the lab, shows its newest certificate, and refuses other clients.

    Args:
        name: Name of the router in the lab file.
        lab: The lab.
        folder: The output folder of `lab certs`.
        results: Collects and prints the results.

    Returns:
        Whether the router's port can be reached.
    """
    endpoint = lab.make_endpoint(name)
    router = CertificateIdentity(lab.file.routers[name].machine, None, name)
    try:
        _connect_without_tls(endpoint).close()
    except OSError as error:
        results.report_failed(
            f"{name}: nothing answers on {endpoint}: {error}; start it on {router.machine}, or open the port"
        )
        return False
    clients = [identity for identity in iterate_identities(lab) if identity.role is not None]
    if not clients:
        return True
    client = clients[0]
    settings = _make_probe_settings(client, lab, folder, [endpoint])
    try:
        with open_probe(json.dumps(settings)) as probe:
            round_trip_ms = 1e3 * probe.measure_round_trip_s()
            results.report_passed(f"{name}: {endpoint}, round trip {round_trip_ms:.2f} ms")
    except NotConnectedError as error:
        results.report_failed(f"{name}: {endpoint} lets {client.common_name} not in: {error}")
        return True
    # A router that was not restarted presents the certificate that it had at its start.
    presented = _read_presented_certificate(endpoint, settings["transport"]["link"]["tls"])
    stored = read_certificate(_get_certificate_path(router, folder))
    if presented.serial_number != stored.serial_number:
        _check_expiry(
            f"{name} shows an earlier certificate",
            presented,
            f"restart it on {router.machine}",
            results,
        )
    _check_refuses_unknown_clients(name, settings, results)
    return True


def _check_refuses_unknown_clients(
    name: str, settings: dict[str, Any], results: CheckResults
) -> None:
    """Check that a router refuses clients without a certificate. `settings` are those of a client with one."""
    tls = settings["transport"]["link"]["tls"]
    settings["transport"]["link"]["tls"] = {"root_ca_certificate": tls["root_ca_certificate"]}
    try:
        with open_probe(json.dumps(settings)):
            results.report_failed(
                f"{name}: accepts clients without a certificate; it does not run with the rendered file"
            )
    except NotConnectedError:
        results.report_passed(f"{name}: refuses clients without a certificate")


def _connect_without_tls(endpoint: str) -> socket.socket:
    """Connect to a router without TLS. Raises OSError."""
    host, _, port = endpoint.removeprefix("tls/").rpartition(":")
    return socket.create_connection(
        (host.strip("[]"), int(port)), timeout=CONNECT_TIMEOUT_MS / 1000
    )


def _read_presented_certificate(endpoint: str, tls: dict[str, Any]) -> x509.Certificate:
    """Return the certificate that a router presents to its clients. `tls` are the certificate files of a client."""
    host = endpoint.removeprefix("tls/").rpartition(":")[0].strip("[]")
    context = ssl.create_default_context(cafile=tls["root_ca_certificate"])
    context.load_cert_chain(tls["connect_certificate"], tls["connect_private_key"])
    with (
        _connect_without_tls(endpoint) as plain,
        context.wrap_socket(plain, server_hostname=host) as wrapped,
    ):
        return x509.load_der_x509_certificate(wrapped.getpeercert(binary_form=True) or b"")


@dataclass(frozen=True)
class _LabRobotState:
    """What the processes of a robot publish."""

    status: RobotStatus | None
    description: RobotDescription | None
    live_services: frozenset[str]  # names of the services with a liveliness token
    processes: list[ProcessInfo]
    # By key: how far the publisher's clock is ahead of this computer's.
    clock_offsets_s: dict[str, float]


def _check_robot(robot: str, lab: LabPlan, folder: Path, results: CheckResults) -> None:
    """Check the processes of a robot: where they run, their versions and settings, and their clocks.

    Args:
        robot: Name of the robot in the lab file.
        lab: The lab.
        folder: The output folder of `lab certs`, with the certificate that the check connects with.
        results: Collects and prints the results.
    """
    involved_identities = [
        identity for identity in iterate_identities(lab) if robot in identity.list_robots(lab)
    ]
    roles = list(Role)
    # Roles are listed from the one with the fewest permissions on; the last one may read the most.
    observer = max(
        involved_identities, key=lambda identity: roles.index(identity.role or Role.ROBOT)
    )
    try:
        state = _observe_robot(observer, robot, lab, folder)
    except NotConnectedError as error:
        results.report_failed(f"cannot be looked at as {observer.common_name}: {error}")
        return
    if state.status is not None:
        results.report_passed(f"{state.status.lifecycle} - {state.status.reason}")
        check_emulation(lab.file.robots[robot], state.description, results)
    host = next((process for process in state.processes if process.name == HOST), None)
    for name, machine in _find_expected_processes(robot, lab, involved_identities).items():
        running = [process for process in state.processes if process.name == name]
        if not running or name not in state.live_services:
            results.report_failed(f"{name}: not running; it belongs on {machine}")
        for process in running:
            _check_process(process, host, state.clock_offsets_s, results)


def _observe_robot(
    watcher: CertificateIdentity, robot: str, lab: LabPlan, folder: Path
) -> _LabRobotState:
    """Connect as one identity and collect what a robot publishes. Raises NotConnectedError."""
    with _open_session(watcher, robot, lab, folder) as session:
        status = session.wait_for_latched(keys.STATUS, RobotStatus, LISTEN_S)
        description = (
            session.wait_for_latched(keys.DESCRIPTION, RobotDescription, LISTEN_S)
            if status is not None
            else None
        )
        live_keys = session.list_tokens(keys.PROCESS_ALL)
        reader = session.declare_latched_reader(keys.PROCESS_ALL, ProcessInfo)
        settings = {**_make_probe_settings(watcher, lab, folder), "namespace": robot}
        with open_probe(json.dumps(settings)) as probe:
            clock_offsets_s = probe.measure_clock_offsets_s(list(WRITER_BY_KEY), LISTEN_S)
        processes = reader.drain()
    live_services = frozenset(keys.parse_service(key).rpartition("-")[0] for key in live_keys)
    return _LabRobotState(status, description, live_services, processes, clock_offsets_s)


def _find_expected_processes(
    robot: str, lab: LabPlan, involved: list[CertificateIdentity]
) -> dict[str, str]:
    """Return the machine of each process that the lab file gives a robot."""
    expected = {HOST: lab.file.robots[robot].machine}
    for identity in involved:
        for service in identity.services:
            expected[service] = identity.machine
        if identity.role is Role.RECORDER:
            expected[RECORDER] = identity.machine
    return expected


def check_emulation(
    robot: LabRobot, description: RobotDescription | None, results: CheckResults
) -> None:
    """Check that a robot whose bus the lab file names has real drives, and that a simulated or emulated one has none.

    A robot of another kind passes, because the lab file does not tell what moves.

    Args:
        robot: The robot's entry in the lab file.
        description: Description that the host of the robot publishes; None if there is none.
        results: Collects and prints the results.
    """
    summary = describe_what_moves(description)
    if description is None:
        results.report_failed(summary)
    elif has_real_drives(robot) and description.emulated:
        results.report_failed(
            f"{summary}, but the lab file names its bus; render again, install, and restart the host"
        )
    elif (robot.backend == SIMULATOR_BACKEND or robot.emulated) and not description.emulated:
        results.report_failed(
            f"{summary}, but by the lab file nothing real is to move; see which host runs"
        )
    else:
        results.report_passed(summary)


def _check_process(
    process: ProcessInfo,
    host: ProcessInfo | None,
    clock_offsets_s: dict[str, float],
    results: CheckResults,
) -> None:
    """Check version and settings of a process against those of the host, and its clock against this computer's.

    Args:
        process: The process.
        host: The host of the robot; None if it does not run.
        clock_offsets_s: Offsets of clocks ahead of this computer, by the key of the messages that show them.
        results: Collects and prints the results.
    """
    results.report_passed(
        f"{process.name}: on {process.machine}, process {process.pid}, snakesim {process.version}"
    )
    if host is not None:
        if process.version != host.version:
            results.report_failed(
                f"{process.name}: snakesim {process.version}, but the host has {host.version}"
            )
        for difference in describe_differences(process, host):
            results.report_failed(f"{process.name}: {difference}")
    for key, process_name in WRITER_BY_KEY.items():
        if process_name != process.name or key not in clock_offsets_s:
            continue
        offset_s = clock_offsets_s[key]
        text = f"{process.name}: clock {offset_s:+.3f} s against this computer's"
        if abs(offset_s) < MAX_CLOCK_OFFSET_S:
            results.report_passed(text)
        else:
            results.report_failed(text)


def _check_role_permissions(
    identity: CertificateIdentity, role: Role, lab: LabPlan, folder: Path, results: CheckResults
) -> None:
    """Check that an identity can connect, and that the routers forward exactly those queries that its role allows.

    Args:
        identity: The identity to connect as.
        role: Role of the identity.
        lab: The lab.
        folder: The output folder of `lab certs`, with the identity's certificate.
        results: Collects and prints the results.
    """
    settings = json.dumps(_make_probe_settings(identity, lab, folder))
    try:
        with open_probe(settings) as probe:
            round_trip_ms = 1e3 * probe.measure_round_trip_s()
            for robot in lab.file.robots:
                may_use_robot = robot in identity.list_robots(lab)
                for access_rule in ACCESS_RULES:
                    if access_rule.key not in QUERIED_KEYS:
                        continue
                    may_query = may_use_robot and "ask" in access_rule.list_actions(role)
                    response_count = probe.count_answers(f"{robot}/{access_rule.key}")
                    query_name = f"{identity.common_name}: {robot}/{access_rule.key}"
                    if response_count and not may_query:
                        results.report_failed(
                            f"{query_name} answers, though the role may not ask; the router has other rules"
                        )
                    elif may_query and not response_count:
                        results.report_failed(
                            f"{query_name} does not answer, though the role may ask; no host, or other rules"
                        )
            results.report_passed(f"{identity.common_name}: round trip {round_trip_ms:.2f} ms")
    except NotConnectedError as error:
        results.report_failed(f"{identity.common_name}: not let in: {error}")


@contextmanager
def _open_session(
    identity: CertificateIdentity, robot: str, lab: LabPlan, folder: Path
) -> Iterator[Session]:
    """Open a session to a robot as one identity. Raises NotConnectedError."""
    with TemporaryDirectory() as scratch:
        path = Path(scratch) / "session.json5"
        path.write_text(json.dumps(_make_probe_settings(identity, lab, folder)), encoding="utf-8")
        link = ConnectionSettings.from_session_file(read_session(path), robot)
        with open_session(link, CONNECT_TIMEOUT_MS / 1000) as session:
            yield session


def _make_probe_settings(
    identity: CertificateIdentity, lab: LabPlan, folder: Path, endpoints: list[str] | None = None
) -> dict[str, Any]:
    """Return Zenoh's settings for a session as one identity, with whole keys and the certificate in `folder`.

    Args:
        identity: The identity to connect as.
        lab: The lab.
        folder: The output folder of `lab certs`.
        endpoints: Endpoints of the routers to connect to; None for all routers of the lab.
    """
    settings = make_session_settings(identity, lab)
    settings.pop("namespace", None)
    settings["connect"]["timeout_ms"] = CONNECT_TIMEOUT_MS
    settings["connect"]["endpoints"] = endpoints or lab.list_endpoints()
    settings["transport"]["link"]["tls"] |= make_tls_paths(
        identity, str(_get_tls_folder(identity, folder)), "connect"
    )
    return settings


def _get_tls_folder(identity: CertificateIdentity, folder: Path) -> Path:
    return folder.absolute() / identity.machine / "tls"


def _get_certificate_path(identity: CertificateIdentity, folder: Path) -> Path:
    return _get_tls_folder(identity, folder) / f"{identity.label}.pem"
