"""The settings that the host and the services of a robot must share, as short texts, to compare them between computers.

Each process reads its own copy of the scenario, perhaps from another checkout. Settings that only one process uses may
differ: the backend, the duration of a run, injected faults, and which process starts a service. So may the abilities
of the drives, which are their control modes and what they measure: the host leaves out those that its backend does not
have, and publishes the remaining ones.
"""

import hashlib
import json
from typing import Any

import msgspec

from snakesim_hal.model.robot import RobotFile
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.wire.quantities import MAX_SHARED_SETTINGS

ABILITIES = ("modes", "measures")  # keys of a drive that may differ
HASH_DIGITS = 12
MAX_LEVELS = 3  # of a key, such as robot.limits.speed_rad_s; deeper tables are hashed
MAX_KEY = 64  # characters
MAX_VALUE = 40  # characters; longer values are hashed


def shared_settings(config: RunConfig) -> dict[str, str]:
    """Return the shared settings by key, each value as a name or JSON, or as a hash if it is long."""
    shared = {
        "robot": _shared_robot(config.robot),
        "scene": msgspec.to_builtins(config.scene),
        "clock_mode": config.clock_mode,
        "rate_hz": config.rate_hz,
        "seed": config.seed,
        "start": msgspec.to_builtins(config.start),
        "mission": msgspec.to_builtins(config.mission),
        "services": {
            name: {"decimation": service.decimation, "latency_ticks": service.latency_ticks}
            for name, service in config.services.items()
        },
        "max_age": msgspec.to_builtins(config.max_age),
        "controller": config.controller.rpartition(":")[2],
    }
    if config.controller_parameters:
        shared[config.control_section] = msgspec.to_builtins(config.controller_parameters)
    for levels in range(MAX_LEVELS, 0, -1):
        settings: dict[str, str] = {}
        for section, value in shared.items():
            _add_settings(settings, section, value, levels)
        if len(settings) <= MAX_SHARED_SETTINGS:
            return settings
    return {section: _hash(value) for section, value in shared.items()}


def _shared_robot(robot: RobotFile) -> dict[str, Any]:
    """Return a robot file without the abilities of its drives."""
    table: dict[str, Any] = msgspec.to_builtins(robot)
    for ability in ABILITIES:
        table["drive"].pop(ability)
    exceptions: dict[str, Any] = {}
    for joint, values in table["joints"].items():
        given = {key: value for key, value in values.items() if value is not None and key not in ABILITIES}
        if given:
            exceptions[joint] = given
    table["joints"] = exceptions
    return table


def _add_settings(settings: dict[str, str], key: str, value: Any, levels: int) -> None:
    """Add a value, or those in a table, to settings. levels: the most that a key may have.

    An empty table adds nothing, so that a key in only one of two tables is the only difference.
    """
    if isinstance(value, dict):
        children = {f"{key}.{name}": child for name, child in value.items()}
        if key.count(".") + 1 < levels and all(len(child_key) <= MAX_KEY for child_key in children):
            for child_key, child in children.items():
                _add_settings(settings, child_key, child, levels)
            return
    text: str = value if isinstance(value, str) and value else json.dumps(value, sort_keys=True)
    settings[key] = text if len(text) <= MAX_VALUE else _hash(value)


def _hash(value: Any) -> str:
    plain = json.dumps(value, sort_keys=True)
    return hashlib.sha256(plain.encode()).hexdigest()[:HASH_DIGITS]
