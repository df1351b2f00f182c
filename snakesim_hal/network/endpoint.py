"""Checks of endpoints and namespaces that people type, because Zenoh's own error messages are terse."""

import re
import socket
from ipaddress import ip_address

from snakesim_hal.base.errors import ConfigError, RefusedError, shorten

DEFAULT_PORT = 7447
DEFAULT_ENDPOINT = f"tcp/127.0.0.1:{DEFAULT_PORT}"
PROTOCOLS = ("tcp", "tls", "quic", "udp", "ws")
VALID_ENDPOINT = "such as tcp/127.0.0.1:7447: PROTOCOL/HOST:PORT"
ENDPOINT_PATTERN = re.compile(
    r"(?P<protocol>[^/]*)/(?P<host>\[[0-9a-fA-F:.]+\]|[A-Za-z0-9._-]+):(?P<port>[0-9]{1,9})(?P<more>[?#].*)?"
)


def check_endpoint(text: str, origin: str) -> str:
    """Return an endpoint if it is valid.

    Args:
        text: Endpoint, such as tcp/127.0.0.1:7447.
        origin: Option or file that the endpoint came from, for the error.

    Raises:
        ConfigError: The endpoint is not valid.
    """
    context = f"{origin} {shorten(text)}"
    if text.startswith("unixsock-stream/") and len(text) > len("unixsock-stream/"):
        return text
    parts = ENDPOINT_PATTERN.fullmatch(text)
    if parts is None:
        raise ConfigError(
            f"{context}: this is not an endpoint; give one {VALID_ENDPOINT}",
            code="network/invalid-address",
        )
    if parts["protocol"] not in PROTOCOLS:
        raise ConfigError(
            f"{context}: the protocol is one of {', '.join(PROTOCOLS)}; give an endpoint {VALID_ENDPOINT}",
            code="network/invalid-address",
        )
    if not 1 <= int(parts["port"]) <= 65535:
        raise ConfigError(
            f"{context}: the port is a number from 1 to 65535; give an endpoint {VALID_ENDPOINT}",
            code="network/invalid-address",
        )
    return text


def require_safe_listening_endpoint(
    endpoint: str, origin: str, *, access_control: bool = False, insecure: bool = False
) -> None:
    """Check that a robot may listen on an endpoint.

    Args:
        endpoint: Endpoint to listen on.
        origin: Option or file that the endpoint came from, for the error.
        access_control: Whether the listener denies everything that its rules do not allow.
        insecure: Whether the user accepts that other machines can connect.

    Raises:
        ConfigError: Other machines could command the robot there, because no access control is set up.
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
    parts = ENDPOINT_PATTERN.fullmatch(endpoint)
    if parts is None:
        return not endpoint.startswith("unixsock-stream/")
    host = parts["host"].strip("[]")
    try:
        return not ip_address(host).is_loopback
    except ValueError:
        return host != "localhost"


def require_loopback_up(endpoint: str) -> None:
    """Check that the loopback interface is up, if an endpoint is on it. A new network namespace has it down.

    Args:
        endpoint: Endpoint to connect to or listen on. Any other endpoint passes.

    Raises:
        RefusedError: The interface is down, so that a client would wait forever.
    """
    parts = ENDPOINT_PATTERN.fullmatch(endpoint)
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

    Args:
        text: Namespace, such as planar13 or lab/planar13.
        origin: Option or file that the namespace came from, for the error.

    Raises:
        ConfigError: The namespace is not valid.
    """
    if not re.fullmatch(r"[^/*$?#\s@]+(/[^/*$?#\s@]+)*", text) or not text.isprintable():
        raise ConfigError(
            f"{origin} {shorten(text)!r}: this is not a namespace; give a name such as planar13 or "
            "lab/planar13, without "
            "spaces and * $ ? # @",
            code="network/invalid-address",
        )
    return text
