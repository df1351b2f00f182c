"""The router drops all traffic of unauthorized clients and of authorized clients that exceed their rights.

The tests connect without a certificate, with an invalid one, or with a valid one of the wrong role.
"""

import contextlib
import itertools
import socket
import threading
import time
from contextlib import ExitStack
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import psutil
import pytest
import zenoh
from cryptography import x509
from cryptography.hazmat.primitives.serialization import load_pem_private_key

from snakesim_hal.network.free_ports import find_free_port
from snakesim_hal.wire.roles import Role
from snakesim_operator.features.lab.certificates import (
    CertificateIssuer,
    issue_certificate,
    load_or_create_authority,
)
from snakesim_operator.features.lab.identities import CertificateIdentity
from snakesim_testing.lab.router_waits import LIMIT_S, eventually, settle
from snakesim_testing.lab.small_lab import OTHER_ROBOT, OWN_ROBOT, RunningLab, open_zenoh_session

COMMAND_KEY = f"{OWN_ROBOT}/actuator/joints"
CONNECT_TIMEOUT_MS = 400
MAX_PAYLOAD_BYTES = 65536  # of a joint command, as the rules of the router limit it
MAX_REPEATED_LOG_LINES = 5  # a refusal that happens 100 times is logged fewer times
SHORT_LIFE_S = 2  # validity of a certificate that expires during a test


def make_settings_with_certificate(
    lab: RunningLab,
    folder: Path,
    identity: CertificateIdentity,
    issuer: CertificateIssuer,
    life: timedelta,
) -> dict[str, Any]:
    """Return session settings with a new certificate.

    Args:
        lab: The lab whose router the session connects to.
        folder: Receives the certificate and its private key.
        identity: Whom the certificate names.
        issuer: Who signs the certificate.
        life: How long the certificate is valid.
    """
    certificate, key = issue_certificate(issuer, identity, lab.lab, life)
    (folder / "own.pem").write_bytes(certificate)
    (folder / "own.key").write_bytes(key)
    settings = lab.make_session_settings(identity)
    settings["transport"]["link"]["tls"].update(
        connect_certificate=str(folder / "own.pem"), connect_private_key=str(folder / "own.key")
    )
    return settings


LOGGED_REASONS = {  # text in the router's log, by the flaw of the certificate
    "another authority": "invalid peer certificate: BadSignature",
    "signed by a role": "invalid peer certificate: UnknownIssuer",
    "expired": "invalid peer certificate: certificate expired",
    "none": "peer sent no certificates",
    "plain tcp": "received corrupt message",
}


@pytest.mark.parametrize("flaw", LOGGED_REASONS)
def test_router_without_valid_certificate_refuses_connection(
    lab: RunningLab, tmp_path: Path, flaw: str
) -> None:
    identity = lab.find_identity_by_role(Role.GNC, OWN_ROBOT)
    day = timedelta(days=1)
    authority = load_or_create_authority(lab.folder / "authority", lab.lab)
    if flaw == "another authority":
        foreign_authority = load_or_create_authority(tmp_path / "foreign", lab.lab)
        settings = make_settings_with_certificate(lab, tmp_path, identity, foreign_authority, day)
    elif flaw == "signed by a role":
        settings = make_settings_with_certificate(
            lab, tmp_path, identity, make_issuer_from_role(lab, authority), day
        )
    elif flaw == "expired":
        settings = make_settings_with_certificate(
            lab, tmp_path, identity, authority, timedelta(seconds=-5)
        )
    else:
        settings = lab.make_session_settings(identity)
        tls = settings["transport"]["link"]["tls"]
        settings["transport"]["link"]["tls"] = {"root_ca_certificate": tls["root_ca_certificate"]}
        if flaw == "plain tcp":
            settings["transport"]["link"]["protocols"] = ["tcp"]
            settings["connect"]["endpoints"] = [lab.lab.list_endpoints()[0].replace("tls/", "tcp/")]
    settings["connect"]["timeout_ms"] = CONNECT_TIMEOUT_MS
    with pytest.raises(zenoh.ZError):
        open_zenoh_session(settings).close()
    assert_logged(lab, LOGGED_REASONS[flaw])


def make_issuer_from_role(lab: RunningLab, authority: CertificateIssuer) -> CertificateIssuer:
    """Return an issuer that signs with the certificate of a viewer instead of an authority."""
    certificate, key = issue_certificate(
        authority, lab.find_identity_by_role(Role.VIEWER, OWN_ROBOT), lab.lab
    )
    private_key: Any = load_pem_private_key(key, None)
    return CertificateIssuer(x509.load_pem_x509_certificate(certificate), private_key)


def test_identity_removed_from_lab_file_cannot_send_commands(
    lab: RunningLab, tmp_path: Path
) -> None:
    """The certificate of the removed identity is still valid, but no rule names it."""
    authority = load_or_create_authority(lab.folder / "authority", lab.lab)
    former = replace(lab.find_identity_by_role(Role.GNC, OWN_ROBOT), machine="laptop")
    settings = make_settings_with_certificate(lab, tmp_path, former, authority, timedelta(days=1))
    assert send_command(lab, settings, "command") == []
    assert_logged(lab, f"refused: {former.common_name} from 127.0.0.1")


@pytest.mark.parametrize("mode", ["peer", "router"])
def test_peer_or_router_session_has_rights_of_its_certificate(lab: RunningLab, mode: str) -> None:
    viewer = lab.find_identity_by_role(Role.VIEWER, OWN_ROBOT)
    gnc = lab.find_identity_by_role(Role.GNC, OWN_ROBOT)
    viewer_settings = lab.make_session_settings(viewer, mode=mode)
    gnc_settings = lab.make_session_settings(gnc, mode=mode)
    assert send_command(lab, viewer_settings, "command") == []
    assert send_command(lab, gnc_settings, "command") == ["command"]


def test_robot_session_listens_on_no_port(lab: RunningLab) -> None:
    """The robot's session listens on no port, so that clients reach it only through the router."""
    before = list_listening_addresses()
    with lab.open_session(lab.find_identity_by_role(Role.ROBOT, OWN_ROBOT)):
        assert list_listening_addresses() == before


def test_message_longer_than_key_allows_is_dropped(lab: RunningLab) -> None:
    settings = lab.make_session_settings(lab.find_identity_by_role(Role.GNC, OWN_ROBOT))
    longest = "x" * MAX_PAYLOAD_BYTES
    assert send_command(lab, settings, longest) == [longest]
    assert send_command(lab, settings, longest + "x") == []


def test_replayed_connection_bytes_send_no_command(lab: RunningLab) -> None:
    """An eavesdropper repeats byte by byte what the controller sent to the router."""
    host, port = lab.lab.list_endpoints()[0].removeprefix("tls/").split(":")
    settings = lab.make_session_settings(lab.find_identity_by_role(Role.GNC, OWN_ROBOT))
    with socket.create_server(("127.0.0.1", 0)) as relay_socket:
        settings["connect"]["endpoints"] = [f"tls/127.0.0.1:{relay_socket.getsockname()[1]}"]
        sent = bytearray()
        threading.Thread(
            target=relay_one_connection, args=(relay_socket, (host, int(port)), sent), daemon=True
        ).start()
        assert send_command(lab, settings, "command") == ["command"]
    assert len(sent) > 1000
    with lab.open_session(lab.find_identity_by_name("router.spare.hub")) as witness:
        received: list[str] = []
        _subscriber = witness.declare_subscriber(
            "**", lambda sample: received.append(sample.payload.to_string())
        )
        settle(witness)
        with socket.create_connection((host, int(port))) as connection:
            connection.sendall(sent)
            connection.settimeout(1.0)
            while connection.recv(65536):  # until the router closes the connection
                pass
        settle(witness)
    assert received == []


def test_router_with_certificate_of_a_role_gets_no_connection(lab: RunningLab) -> None:
    """A controller does not connect to a router that has the certificate of a viewer."""
    viewer = lab.find_identity_by_role(Role.VIEWER, OWN_ROBOT)
    gnc = lab.find_identity_by_role(Role.GNC, OWN_ROBOT)
    endpoint = f"tls/127.0.0.1:{find_free_port()}"
    settings = lab.make_session_settings(
        viewer, mode="router", listen={"endpoints": [endpoint]}, connect={"endpoints": []}
    )
    tls = settings["transport"]["link"]["tls"]
    tls.update(
        listen_certificate=tls["connect_certificate"], listen_private_key=tls["connect_private_key"]
    )
    with open_zenoh_session(settings), pytest.raises(zenoh.ZError):
        lab.open_session(
            gnc, connect={"endpoints": [endpoint], "timeout_ms": CONNECT_TIMEOUT_MS}
        ).close()


def test_router_log_contains_only_admissions_and_refusals(lab: RunningLab) -> None:
    """A refusal that happens often has few lines, and messages that the client did not send have none."""
    administrator = lab.find_identity_by_role(Role.ADMINISTRATOR, OTHER_ROBOT)
    with lab.open_session(administrator) as session:
        for _ in range(100):
            session.put(COMMAND_KEY, "x")
        settle(session)
        # A query that expires before it is sent is not sent. Nothing here waits for its answer.
        session.get(f"{OWN_ROBOT}/hal/lifecycle", timeout=LIMIT_S)
        settle(session)
    name = administrator.common_name
    assert_logged(lab, f"let in: {name} from 127.0.0.1")
    assert_logged(lab, f"refused: {name}: Put (ingress) on {COMMAND_KEY}")
    assert_logged(lab, f"refused: {name}: Query (ingress) on {OWN_ROBOT}/hal/lifecycle")
    lines = [
        line for line in lab.read_router_log() if name in line and " on unused/key" not in line
    ]
    assert len([line for line in lines if "Put (ingress)" in line]) < MAX_REPEATED_LOG_LINES
    assert not [line for line in lines if "Reply" in line or "Delete" in line]


def assert_logged(lab: RunningLab, text: str) -> None:
    """Wait until a line of the router's log contains a text."""
    eventually(lambda: any(text in line for line in lab.read_router_log()), True)


def send_command(lab: RunningLab, settings: dict[str, Any], command: str) -> list[str]:
    """Put a command with a session of these settings, and return the payloads that reach the robot."""
    received: list[str] = []
    with lab.open_session(lab.find_identity_by_role(Role.ROBOT, OWN_ROBOT)) as robot:
        _subscriber = robot.declare_subscriber(
            COMMAND_KEY, lambda sample: received.append(sample.payload.to_string())
        )
        settle(robot)
        with open_zenoh_session(settings) as session:
            settle(session)
            session.put(COMMAND_KEY, command)
            settle(session, robot)
    return received


def list_listening_addresses() -> set[tuple[str, int]]:
    """Return the TCP addresses on which this process accepts connections."""
    sockets = psutil.Process().net_connections("tcp")
    return {socket.laddr for socket in sockets if socket.status == psutil.CONN_LISTEN}


def relay_one_connection(
    relay_socket: socket.socket, router_address: tuple[str, int], sent: bytearray
) -> None:
    """Relay one connection to the router, and append the bytes of the client to `sent`."""
    client, _ = relay_socket.accept()
    router = socket.create_connection(router_address)

    def relay_answers() -> None:
        with contextlib.suppress(ConnectionError):
            while piece := router.recv(65536):
                client.sendall(piece)
        with contextlib.suppress(OSError):  # The client is gone, too.
            # A shutdown ends the `recv` below. Closing would make its descriptor invalid.
            client.shutdown(socket.SHUT_RDWR)

    answers = threading.Thread(target=relay_answers, daemon=True)
    with client, router:
        answers.start()
        with contextlib.suppress(ConnectionError):
            while piece := client.recv(65536):
                sent += piece
                router.sendall(piece)
        with contextlib.suppress(OSError):  # The router is gone, too.
            router.shutdown(socket.SHUT_RDWR)
        answers.join()


def test_session_with_renewed_certificate_continues_and_expired_one_ends(
    lab: RunningLab, tmp_path: Path
) -> None:
    """A session reconnects by itself if its short-lived certificate was renewed on disk; otherwise it ends."""
    authority = load_or_create_authority(lab.folder / "authority", lab.lab)
    life = timedelta(seconds=SHORT_LIFE_S)
    arrival_times_s: dict[str, list[float]] = {"renewed": [], "ended": []}
    for name in arrival_times_s:
        (tmp_path / name).mkdir()
    identity = lab.find_identity_by_role(Role.GNC, OWN_ROBOT)
    settings = {
        name: make_settings_with_certificate(lab, tmp_path / name, identity, authority, life)
        for name in arrival_times_s
    }
    with (
        lab.open_session(lab.find_identity_by_role(Role.ROBOT, OWN_ROBOT)) as robot,
        ExitStack() as stack,
    ):
        sessions = {
            name: stack.enter_context(open_zenoh_session(settings[name]))
            for name in arrival_times_s
        }
        make_settings_with_certificate(
            lab, tmp_path / "renewed", identity, authority, timedelta(days=1)
        )

        def record_arrival(sample: zenoh.Sample) -> None:
            arrival_times_s[sample.payload.to_string()].append(time.monotonic())

        _subscriber = robot.declare_subscriber(COMMAND_KEY, record_arrival)
        start_s = time.monotonic()
        while time.monotonic() < start_s + 4.0:
            for name, session in sessions.items():
                session.put(COMMAND_KEY, name)
            time.sleep(0.005)
    assert arrival_times_s["ended"][-1] < start_s + 2.5
    assert arrival_times_s["renewed"][-1] > start_s + 3.5
    gaps_s = [later - earlier for earlier, later in itertools.pairwise(arrival_times_s["renewed"])]
    print(f"longest gap of a session that reconnects: {1e3 * max(gaps_s):.0f} ms")
