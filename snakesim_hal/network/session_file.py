"""A Zenoh session file: how a machine joins its lab's network. Stock Zenoh reads it too; nothing of ours is in it.

It names the router, and the certificates if there are any. What every session of SnakeSIM needs is set on top; a file
with other values is refused, because the same file would behave differently in another program.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zenoh

from snakesim_hal.base.errors import ConfigError, shorten
from snakesim_hal.model.textfiles import check_nesting_depth, read_text
from snakesim_hal.network.endpoint import check_endpoint, check_namespace
from snakesim_hal.network.private_keys import warn_about_readable_keys

# Values that a file may leave out, except the mode, which is `peer` when left out.
REQUIRED: dict[str, Any] = {
    "mode": "client",
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
}


@dataclass(frozen=True)
class SessionFile:
    """A checked session file."""

    path: Path
    text: str  # JSON5
    endpoints: tuple[str, ...]  # of routers: the first that answers is used
    namespace: str | None  # of the only robot that this session can see; None: the file names none

    def resolve_namespace(self, requested: str | None) -> str | None:
        """Return the namespace of a session: the requested one, or that of the file.

        Args:
            requested: Namespace that the user requests. None if the user requests none.

        Returns:
            The namespace, or None if neither the user nor the file names one.

        Raises:
            ConfigError: The file names another namespace than the user.
        """
        if self.namespace is not None and requested not in (None, self.namespace):
            raise ConfigError(
                f"{self.path}: `namespace` is {shorten(self.namespace)!r}, not {requested!r}; use the session "
                "file of that "
                "robot, or another --namespace",
                code="network/session-file",
            )
        return requested or self.namespace


def read_session(path: Path) -> SessionFile:
    """Read and check a Zenoh session file, without connecting.

    Args:
        path: JSON5 file for a Zenoh client. It may contain one namespace, and must not contain `listen.endpoints`.

    Returns:
        The checked content of the file, with the endpoints of its routers.

    Raises:
        ConfigError: The file cannot be read, or is not a session file for SnakeSIM.
    """
    text, settings = read_zenoh_file(path)
    for key, required_value in REQUIRED.items():
        _check_required_value(path, key, json.loads(settings.get_json(key)), required_value)
    endpoints = _read_router_endpoints(path, settings)
    namespace = json.loads(settings.get_json("namespace"))
    if namespace is not None:
        check_namespace(namespace, f"{path}: `namespace`:")
    return SessionFile(path.absolute(), text, tuple(endpoints), namespace)


def _check_required_value(path: Path, key: str, value: Any, required: Any) -> None:
    """Raise ConfigError if a file sets a key to another value than the required one."""
    may_be_missing = key != "mode"  # a missing mode means `peer`
    if value == required or (value is None and may_be_missing):
        return
    dotted_key = key.replace("/", ".")
    shown_value = "missing" if value is None else json.dumps(value)
    raise ConfigError(
        f"{path}: `{dotted_key}` is {shown_value}, must be {json.dumps(required)}",
        code="network/session-file",
    )


def _read_router_endpoints(path: Path, settings: zenoh.Config) -> list[str]:
    """Return the valid endpoints of the routers that a file names. Raises ConfigError if there are none."""
    if read_endpoints(settings, "listen/endpoints", "client"):
        raise ConfigError(
            f"{path}: `listen.endpoints`: a session only connects; leave it out",
            code="network/session-file",
        )
    endpoints = read_endpoints(settings, "connect/endpoints", "client")
    if not endpoints:
        raise ConfigError(
            f"{path}: `connect.endpoints` is empty: name the router's, such as tls/robot-lab:7447",
            code="network/session-file",
        )
    for endpoint in endpoints:
        check_endpoint(endpoint, f"{path}: `connect.endpoints`:")
    return endpoints


def read_zenoh_file(path: Path) -> tuple[str, zenoh.Config]:
    """Read a JSON5 file of Zenoh.

    Returns:
        The text, and the settings that Zenoh reads in it.

    Raises:
        ConfigError: The file cannot be read, or Zenoh refuses it.
    """
    text = read_text(path)
    check_nesting_depth(text, str(path))
    try:
        settings = zenoh.Config.from_json5(text)
    except zenoh.ZError as error:
        raise make_zenoh_refusal_error(path, error) from error
    warn_about_readable_keys(settings)
    return text, settings


def make_zenoh_refusal_error(path: Path, error: zenoh.ZError) -> ConfigError:
    """Return an error with Zenoh's own message about a file, shortened because it quotes the file."""
    message = " ".join(str(error).split())
    return ConfigError(
        f"{path}: Zenoh refuses it: {shorten(message, 500)}", code="network/session-file"
    )


def read_endpoints(settings: zenoh.Config, key: str, mode: str) -> list[str]:
    """Return the endpoints that a setting lists for a mode of Zenoh.

    Args:
        settings: Settings of a Zenoh file, which has one list for all modes, or one for each mode.
        key: Key of the setting, "connect/endpoints" or "listen/endpoints".
        mode: Mode of the session, "client" or "router".
    """
    value = json.loads(settings.get_json(key))
    return value if isinstance(value, list) else value.get(mode, [])
