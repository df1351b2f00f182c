"""Runs a Zenoh router from a JSON5 file: `snakesim start router`."""

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

import zenoh

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.network.endpoint import require_safe_listening_endpoint
from snakesim_hal.network.router_log import ZENOH_LEVELS, shortened_zenoh_log
from snakesim_hal.network.session_file import (
    make_zenoh_refusal_error,
    read_endpoints,
    read_zenoh_file,
)


def read_router_settings(config: Path) -> zenoh.Config:
    """Read the settings in a router's JSON5 file, without opening anything.

    Raises:
        ConfigError: The file cannot be read, or is not for a router.
    """
    _, settings = read_zenoh_file(config)
    if json.loads(settings.get_json("mode")) != "router":
        raise ConfigError(f'{config}: `mode` must be "router"', code="network/session-file")
    return settings


def _is_denying_by_default(settings: zenoh.Config) -> bool:
    """Return whether the access control denies everything that its rules do not allow."""
    rules = json.loads(settings.get_json("access_control"))
    return bool(rules["enabled"]) and rules["default_permission"] == "deny"


@contextmanager
def open_router(config: Path, *, insecure: bool = False) -> Iterator[None]:
    """Run a Zenoh router from a JSON5 file while the context lasts.

    The log of Zenoh is shortened, unless RUST_LOG sets its levels.

    Args:
        config: Path of the file.
        insecure: Whether to run also a router that other machines can connect to without access control.

    Raises:
        ConfigError: The file is not valid, or the router would let other machines command a robot.
    """
    settings = read_router_settings(config)
    for endpoint in read_endpoints(settings, "listen/endpoints", "router"):
        has_access_control = _is_denying_by_default(settings)
        require_safe_listening_endpoint(
            endpoint,
            f"{config}: `listen.endpoints`:",
            access_control=has_access_control,
            insecure=insecure,
        )
    with nullcontext() if "RUST_LOG" in os.environ else shortened_zenoh_log():
        zenoh.init_log_from_env_or(ZENOH_LEVELS)
        try:
            session = zenoh.open(settings)
        except zenoh.ZError as error:
            raise make_zenoh_refusal_error(config, error) from error
        with session:
            yield
