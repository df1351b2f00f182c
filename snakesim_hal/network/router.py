"""Runs a Zenoh router from a JSON5 file: `snakesim start router`."""

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

import zenoh

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.network.endpoint import check_guarded
from snakesim_hal.network.router_log import ZENOH_LEVELS, short_log
from snakesim_hal.network.session_file import endpoints_of_mode, read_zenoh_file, refused_by_zenoh


def router_settings(config: Path) -> zenoh.Config:
    """Read the settings in a router's JSON5 file, without opening anything.

    Raises:
        ConfigError: the file cannot be read, or is not for a router.
    """
    _, settings = read_zenoh_file(config)
    if json.loads(settings.get_json("mode")) != "router":
        raise ConfigError(f'{config}: `mode` must be "router"', code="network/session-file")
    return settings


def _denies_by_default(settings: zenoh.Config) -> bool:
    """Return whether the access control denies everything that its rules do not allow."""
    rules = json.loads(settings.get_json("access_control"))
    return bool(rules["enabled"]) and rules["default_permission"] == "deny"


@contextmanager
def open_router(config: Path, *, insecure: bool = False) -> Iterator[None]:
    """Run a Zenoh router from a JSON5 file for as long as the context lives.

    Its log is short, unless RUST_LOG sets Zenoh's own levels.

    Args:
        config: the file.
        insecure: also run a router that other machines can connect to without access control.

    Raises:
        ConfigError: the file is not valid, or the router would let other machines command a robot.
    """
    settings = router_settings(config)
    for endpoint in endpoints_of_mode(settings, "listen/endpoints", "router"):
        guarded = _denies_by_default(settings)
        check_guarded(endpoint, f"{config}: `listen.endpoints`:", access_control=guarded, insecure=insecure)
    with nullcontext() if "RUST_LOG" in os.environ else short_log():
        zenoh.init_log_from_env_or(ZENOH_LEVELS)
        try:
            session = zenoh.open(settings)
        except zenoh.ZError as error:
            raise refused_by_zenoh(config, error) from error
        with session:
            yield
