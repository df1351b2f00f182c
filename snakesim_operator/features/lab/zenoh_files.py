"""Creates the configuration of a lab's routers and sessions, as an unmodified Zenoh reads it."""

from typing import Any

from snakesim_hal.wire.codec import MAX_IMAGE_BYTES
from snakesim_operator.features.lab.access import (
    MAX_ENVELOPE_BYTES,
    make_access_control,
    make_size_limits,
)
from snakesim_operator.features.lab.identities import CertificateIdentity
from snakesim_operator.features.lab.lab_file import ALL_ROBOTS, LabPlan

NO_SCOUTING = {"multicast": {"enabled": False}, "gossip": {"enabled": False}}
TIMESTAMPS = {"enabled": {"router": True, "peer": True, "client": True}}
LINK_LEASE_MS = 2000  # after which a silent link is closed


def make_router_settings(identity: CertificateIdentity, lab: LabPlan) -> dict[str, Any]:
    """Return the Zenoh configuration of a router, with certificates, access rules and limits of message sizes.

    The router listens with TLS on its machine's address, requires a certificate of every client, and enforces the
    access rules. It connects to the routers before it in the lab file, so that each pair of routers has one connection.

    Args:
        identity: The router.
        lab: The lab.
    """
    names = list(lab.file.routers)
    earlier_routers = names[: names.index(identity.subject)]
    folder = f"{lab.file.machines[identity.machine].folder}/tls"
    listen_files = make_tls_paths(identity, folder, "listen")
    connect_files = make_tls_paths(identity, folder, "connect")
    tls = {**listen_files, **connect_files, "enable_mtls": True}
    return {
        "mode": "router",
        "listen": {"endpoints": [lab.make_endpoint(identity.subject)], "exit_on_failure": True},
        "connect": {
            "endpoints": [lab.make_endpoint(name) for name in earlier_routers],
            "timeout_ms": -1,  # tries without end
            "exit_on_failure": False,
        },
        "scouting": NO_SCOUTING,
        "timestamping": TIMESTAMPS,
        "adminspace": {"enabled": True, "permissions": {"read": True, "write": False}},
        "transport": {
            "unicast": {"accept_timeout": 2000, "accept_pending": 200, "max_sessions": 500},
            "link": _make_link_settings(tls),
            "shared_memory": {"enabled": False},
        },
        "access_control": make_access_control(lab),
        "low_pass_filter": make_size_limits(),
    }


def make_session_settings(identity: CertificateIdentity, lab: LabPlan) -> dict[str, Any]:
    """Return the settings of a session of one role: a client of the routers that does not listen."""
    folder = f"{lab.file.machines[identity.machine].folder}/tls"
    settings: dict[str, Any] = {
        "mode": "client",
        "connect": {"endpoints": lab.list_endpoints(), "timeout_ms": 5000, "exit_on_failure": True},
        "listen": {"endpoints": []},
        "scouting": NO_SCOUTING,
        "timestamping": TIMESTAMPS,
        "transport": {
            "link": _make_link_settings(
                {**make_tls_paths(identity, folder, "connect"), "enable_mtls": True}
            ),
            "shared_memory": {"enabled": False},
        },
    }
    if identity.subject != ALL_ROBOTS:
        settings["namespace"] = identity.subject
    return settings


def _make_link_settings(tls: dict[str, Any]) -> dict[str, Any]:
    # `close_link_on_expiration`: an expired certificate ends its session too.
    return {
        "protocols": ["tls"],
        "tx": {
            "lease": LINK_LEASE_MS,
            "queue": {"congestion_control": {"drop": {"wait_before_drop": 100}}},
        },
        "rx": {"max_message_size": MAX_IMAGE_BYTES + MAX_ENVELOPE_BYTES},
        "tls": {**tls, "verify_name_on_connect": True, "close_link_on_expiration": True},
    }


def make_tls_paths(identity: CertificateIdentity, folder: str, side: str) -> dict[str, Any]:
    """Return the paths of an identity's certificate files for Zenoh. `side` is `listen` or `connect`."""
    return {
        "root_ca_certificate": f"{folder}/authority.pem",
        f"{side}_certificate": f"{folder}/{identity.label}.pem",
        f"{side}_private_key": f"{folder}/{identity.label}.key",
    }
