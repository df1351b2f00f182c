"""Who has no certificate, a wrong one, or a right one and wrong intentions: nothing of theirs passes the router."""

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
from snakesim_testing.lab.router_waits import eventually, settle
from snakesim_testing.lab.small_lab import OTHER_ROBOT, OWN_ROBOT, RunningLab, open_zenoh_session

COMMAND = f"{OWN_ROBOT}/actuator/joints"


def with_certificate(
    lab: RunningLab,
    folder: Path,
    who: CertificateIdentity,
    issuer: CertificateIssuer,
    life: timedelta,
) -> dict[str, Any]:
    """Settings of a session with a certificate that the lab did not make."""
    certificate, key = issue_certificate(issuer, who, lab.lab, life)
    (folder / "own.pem").write_bytes(certificate)
    (folder / "own.key").write_bytes(key)
    settings = lab.make_session_settings(who)
    settings["transport"]["link"]["tls"].update(
        connect_certificate=str(folder / "own.pem"), connect_private_key=str(folder / "own.key")
    )
    return settings


REASONS = {  # in the words of the router's log
    "another authority": "invalid peer certificate: BadSignature",
    "signed by a role": "invalid peer certificate: UnknownIssuer",
    "expired": "invalid peer certificate: certificate expired",
    "none": "peer sent no certificates",
    "plain tcp": "received corrupt message",
}


@pytest.mark.parametrize("flaw", REASONS)
def test_without_a_valid_certificate_nobody_is_let_in(
    lab: RunningLab, tmp_path: Path, flaw: str
) -> None:
    who, day = lab.find_identity_by_role(Role.GNC, OWN_ROBOT), timedelta(days=1)
    own = load_or_create_authority(lab.folder / "authority", lab.lab)
    if flaw == "another authority":
        settings = with_certificate(
            lab, tmp_path, who, load_or_create_authority(tmp_path / "foreign", lab.lab), day
        )
    elif flaw == "signed by a role":
        settings = with_certificate(lab, tmp_path, who, role_as_issuer(lab, own), day)
    elif flaw == "expired":
        settings = with_certificate(lab, tmp_path, who, own, timedelta(seconds=-5))
    else:
        settings = lab.make_session_settings(who)
        tls = settings["transport"]["link"]["tls"]
        settings["transport"]["link"]["tls"] = {"root_ca_certificate": tls["root_ca_certificate"]}
        if flaw == "plain tcp":
            settings["transport"]["link"]["protocols"] = ["tcp"]
            settings["connect"]["endpoints"] = [lab.lab.list_endpoints()[0].replace("tls/", "tcp/")]
    settings["connect"]["timeout_ms"] = 400
    with pytest.raises(zenoh.ZError):
        open_zenoh_session(settings).close()
    assert_told(lab, REASONS[flaw])


def role_as_issuer(lab: RunningLab, own: CertificateIssuer) -> CertificateIssuer:
    """Somebody who signs with the certificate of a role."""
    certificate, key = issue_certificate(
        own, lab.find_identity_by_role(Role.VIEWER, OWN_ROBOT), lab.lab
    )
    private: Any = load_pem_private_key(key, None)
    return CertificateIssuer(x509.load_pem_x509_certificate(certificate), private)


def test_who_was_taken_out_of_the_lab_file_is_nobody(lab: RunningLab, tmp_path: Path) -> None:
    """Their certificate is still valid, but no rule names it."""
    own = load_or_create_authority(lab.folder / "authority", lab.lab)
    former = replace(lab.find_identity_by_role(Role.GNC, OWN_ROBOT), machine="laptop")
    settings = with_certificate(lab, tmp_path, former, own, timedelta(days=1))
    assert passed(lab, settings, "command") == []
    assert_told(lab, f"refused: {former.common_name} from 127.0.0.1")


@pytest.mark.parametrize("mode", ["peer", "router"])
def test_intruder_peer_or_router_has_rights_of_its_certificate(lab: RunningLab, mode: str) -> None:
    assert (
        passed(
            lab,
            lab.make_session_settings(lab.find_identity_by_role(Role.VIEWER, OWN_ROBOT), mode=mode),
            "command",
        )
        == []
    )
    assert passed(
        lab,
        lab.make_session_settings(lab.find_identity_by_role(Role.GNC, OWN_ROBOT), mode=mode),
        "command",
    ) == ["command"]


def test_no_session_can_be_reached_around_the_router(lab: RunningLab) -> None:
    """The robot's session listens nowhere, so nobody connects to it but through the router."""
    before = listening()
    with lab.open_session(lab.find_identity_by_role(Role.ROBOT, OWN_ROBOT)):
        assert listening() == before


def test_a_longer_message_than_the_key_can_have_is_dropped(lab: RunningLab) -> None:
    settings = lab.make_session_settings(lab.find_identity_by_role(Role.GNC, OWN_ROBOT))
    assert passed(lab, settings, "x" * 65536) == ["x" * 65536]
    assert passed(lab, settings, "x" * 65537) == []


def test_bytes_that_are_sent_again_command_nothing(lab: RunningLab) -> None:
    """An eavesdropper repeats, byte by byte, what the controller sent to the router."""
    host, port = lab.lab.list_endpoints()[0].removeprefix("tls/").split(":")
    settings = lab.make_session_settings(lab.find_identity_by_role(Role.GNC, OWN_ROBOT))
    with socket.create_server(("127.0.0.1", 0)) as tap:
        settings["connect"]["endpoints"] = [f"tls/127.0.0.1:{tap.getsockname()[1]}"]
        sent = bytearray()
        threading.Thread(target=relay, args=(tap, (host, int(port)), sent), daemon=True).start()
        assert passed(lab, settings, "command") == ["command"]
    assert len(sent) > 1000
    with lab.open_session(lab.find_identity_by_name("router.spare.hub")) as witness:
        heard: list[str] = []
        _kept = witness.declare_subscriber(
            "**", lambda sample: heard.append(sample.payload.to_string())
        )
        settle(witness)
        with socket.create_connection((host, int(port))) as again:
            again.sendall(sent)
            again.settimeout(1.0)
            while again.recv(65536):  # until the router hangs up
                pass
        settle(witness)
    assert heard == []


def test_a_role_cannot_pose_as_the_router(lab: RunningLab) -> None:
    """A viewer's certificate at the router's address: nobody gives it a command."""
    viewer, gnc = (
        lab.find_identity_by_role(Role.VIEWER, OWN_ROBOT),
        lab.find_identity_by_role(Role.GNC, OWN_ROBOT),
    )
    endpoint = f"tls/127.0.0.1:{find_free_port()}"
    settings = lab.make_session_settings(
        viewer, mode="router", listen={"endpoints": [endpoint]}, connect={"endpoints": []}
    )
    tls = settings["transport"]["link"]["tls"]
    tls.update(
        listen_certificate=tls["connect_certificate"], listen_private_key=tls["connect_private_key"]
    )
    with open_zenoh_session(settings), pytest.raises(zenoh.ZError):
        lab.open_session(gnc, connect={"endpoints": [endpoint], "timeout_ms": 400}).close()


def test_router_log_states_only_who_joined_and_what_was_refused(lab: RunningLab) -> None:
    """Once a line, however often it happens; what nobody asked for is not in it."""
    who = lab.find_identity_by_role(Role.ADMINISTRATOR, OTHER_ROBOT)
    with lab.open_session(who) as session:
        for _ in range(100):
            session.put(COMMAND, "x")
        session.get(f"{OWN_ROBOT}/hal/lifecycle", timeout=0.2)
        settle(session)
    assert_told(lab, f"let in: {who.common_name} from 127.0.0.1")
    for what in (f"Put (ingress) on {COMMAND}", f"Query (ingress) on {OWN_ROBOT}/hal/lifecycle"):
        assert_told(lab, f"refused: {who.common_name}: {what}")
    own = [
        line
        for line in lab.read_router_log()
        if who.common_name in line and " on unused/key" not in line
    ]
    assert len([line for line in own if "Put (ingress)" in line]) < 5
    assert not [line for line in own if "Reply" in line or "Delete" in line]


def assert_told(lab: RunningLab, what: str) -> None:
    """The router's log has it, at the latest in a moment."""
    eventually(lambda: any(what in line for line in lab.read_router_log()), True)


def passed(lab: RunningLab, settings: dict[str, Any], command: str) -> list[str]:
    """What the robot hears when a session with these settings puts a command."""
    heard: list[str] = []
    with lab.open_session(lab.find_identity_by_role(Role.ROBOT, OWN_ROBOT)) as robot:
        _kept = robot.declare_subscriber(
            COMMAND, lambda sample: heard.append(sample.payload.to_string())
        )
        settle(robot)
        with open_zenoh_session(settings) as session:
            settle(session)
            session.put(COMMAND, command)
            settle(session, robot)
    return heard


def listening() -> set[tuple[str, int]]:
    """Where somebody could connect to this process by TCP."""
    sockets = psutil.Process().net_connections("tcp")
    return {socket.laddr for socket in sockets if socket.status == psutil.CONN_LISTEN}


def relay(tap: socket.socket, router: tuple[str, int], sent: bytearray) -> None:
    """Pass one connection on, and keep what the client sent."""
    client, _ = tap.accept()
    onward = socket.create_connection(router)

    def relay_answers() -> None:
        with contextlib.suppress(ConnectionError):
            while piece := onward.recv(65536):
                client.sendall(piece)
        with contextlib.suppress(OSError):  # The client is gone, too.
            # This ends the receive below. Closing would take its descriptor away.
            client.shutdown(socket.SHUT_RDWR)

    answers = threading.Thread(target=relay_answers, daemon=True)
    with client, onward:
        answers.start()
        with contextlib.suppress(ConnectionError):
            while piece := client.recv(65536):
                sent += piece
                onward.sendall(piece)
        with contextlib.suppress(OSError):  # The router is gone, too.
            onward.shutdown(socket.SHUT_RDWR)
        answers.join()


def test_renewed_certificate_continues_and_expired_one_is_excluded(
    lab: RunningLab, tmp_path: Path
) -> None:
    """A session with a short certificate connects again by itself when it is renewed on the disk; otherwise it ends."""
    own, life = load_or_create_authority(lab.folder / "authority", lab.lab), timedelta(seconds=2)
    heard: dict[str, list[float]] = {"renewed": [], "ended": []}
    for name in heard:
        (tmp_path / name).mkdir()
    who = lab.find_identity_by_role(Role.GNC, OWN_ROBOT)
    settings = {name: with_certificate(lab, tmp_path / name, who, own, life) for name in heard}
    with (
        lab.open_session(lab.find_identity_by_role(Role.ROBOT, OWN_ROBOT)) as robot,
        ExitStack() as held,
    ):
        sessions = {name: held.enter_context(open_zenoh_session(settings[name])) for name in heard}
        with_certificate(lab, tmp_path / "renewed", who, own, timedelta(days=1))

        def take(sample: zenoh.Sample) -> None:
            heard[sample.payload.to_string()].append(time.monotonic())

        _kept = robot.declare_subscriber(COMMAND, take)
        began = time.monotonic()
        while time.monotonic() < began + 4.0:
            for name, session in sessions.items():
                session.put(COMMAND, name)
            time.sleep(0.005)
    assert heard["ended"][-1] < began + 2.5
    assert heard["renewed"][-1] > began + 3.5
    gaps = [after - before for before, after in itertools.pairwise(heard["renewed"])]
    print(f"the longest gap of a session that connects again: {1e3 * max(gaps):.0f} ms")
