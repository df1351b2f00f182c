"""Checks of endpoints and namespaces that people type, because Zenoh's own error messages are terse."""

import re
import socket
from ipaddress import ip_address

from snakesim_hal.base.errors import ConfigError, RefusedError, shorten

DEFAULT_PORT = 7447
DEFAULT_ENDPOINT = f"tcp/127.0.0.1:{DEFAULT_PORT}"
PROTOCOLS = ("tcp", "tls", "quic", "udp", "ws")
VALID = "such as tcp/127.0.0.1:7447: PROTOCOL/HOST:PORT"
_parts = re.compile(
    r"(?P<protocol>[^/]*)/(?P<host>\[[0-9a-fA-F:.]+\]|[A-Za-z0-9._-]+):(?P<port>[0-9]{1,9})(?P<more>[?#].*)?"
)


def check_endpoint(text: str, origin: str) -> str:
    """Return an endpoint if it is valid.

    Args:
        text: the endpoint.
        origin: the option or file that it came from, for the error.

    Raises:
        ConfigError: it is not valid.
    """
    where = f"{origin} {shorten(text)}"
    if text.startswith("unixsock-stream/") and len(text) > len("unixsock-stream/"):
        return text
    parts = _parts.fullmatch(text)
    if parts is None:
        raise ConfigError(f"{where}: this is not an endpoint; give one {VALID}", code="network/invalid-address")
    if parts["protocol"] not in PROTOCOLS:
        raise ConfigError(
            f"{where}: the protocol is one of {', '.join(PROTOCOLS)}; give an endpoint {VALID}",
            code="network/invalid-address",
        )
    if not 1 <= int(parts["port"]) <= 65535:
        raise ConfigError(
            f"{where}: the port is a number from 1 to 65535; give an endpoint {VALID}",
            code="network/invalid-address",
        )
    return text


def check_guarded(endpoint: str, origin: str, *, access_control: bool = False, insecure: bool = False) -> None:
    """Check that a robot may listen on an endpoint.

    Raises:
        ConfigError: other machines could command the robot there, because no access control is set up.
    """
    if access_control or insecure or not is_exposed(endpoint):
        return
    raise ConfigError(
        f"{origin} {shorten(endpoint)}: anyone who reaches this address could command the robot, because "
        "clients are not "
        f"authenticated. Listen on loopback, let the robot join a router with access control (`snakesim start router "
        f"FILE`, `snakesim run --router ENDPOINT`), or accept it with --insecure",
        code="network/insecure-endpoint",
    )


def is_exposed(endpoint: str) -> bool:
    """Return whether other machines may connect to an endpoint, because it is not on loopback."""
    parts = _parts.fullmatch(endpoint)
    if parts is None:
        return not endpoint.startswith("unixsock-stream/")
    host = parts["host"].strip("[]")
    try:
        return not ip_address(host).is_loopback
    except ValueError:
        return host != "localhost"


def check_loopback(endpoint: str) -> None:
    """Check that an endpoint on loopback can be reached at all: a new network namespace has that interface down.

    Raises:
        RefusedError: it cannot; a client would wait there forever.
    """
    parts = _parts.fullmatch(endpoint)
    if parts is None or is_exposed(endpoint):
        return
    host = parts["host"].strip("[]")
    address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(address_family, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((host, int(parts["port"])))  # sends nothing
        except OSError as error:
            raise RefusedError(
                f"{endpoint}: the loopback interface of this computer, container or network namespace is down "
                f"({error.strerror}), and the processes of a robot meet there. Bring it up with `ip link set lo up` as "
                "root, or run in one process with `snakesim run --in-process`",
                code="network/loopback-down",
            ) from None


def check_namespace(text: str, origin: str) -> str:
    """Return a namespace if it is valid.

    Raises:
        ConfigError: it is not valid.
    """
    if not re.fullmatch(r"[^/*$?#\s@]+(/[^/*$?#\s@]+)*", text) or not text.isprintable():
        raise ConfigError(
            f"{origin} {shorten(text)!r}: this is not a namespace; give a name such as planar13 or "
            "lab/planar13, without "
            "spaces and * $ ? # @",
            code="network/invalid-address",
        )
    return text
