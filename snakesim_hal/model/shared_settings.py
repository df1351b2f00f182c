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

from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.wire.quantities import MAX_SHARED_SETTINGS

DRIVE_ABILITIES = ("modes", "measures")  # keys of a drive that may differ
HASH_DIGITS = 12
MAX_KEY_LEVELS = 3  # of a key, such as robot.limits.speed_rad_s; deeper tables are hashed
MAX_KEY_LENGTH = 64  # characters
MAX_VALUE_LENGTH = 40  # characters; longer values are hashed


def collect_shared_settings(config: RunConfig) -> dict[str, str]:
    """Collect the settings that the host and the services must share, as texts by dotted key.

    Args:
        config: Configuration of the run.

    Returns:
        At most MAX_SHARED_SETTINGS settings. A value is a name or JSON, or a hash if it is long. If there would be more
        settings, whole tables are hashed.
    """
    value_by_section = {
        "robot": _collect_robot_settings(config.robot),
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
        value_by_section[config.control_section] = msgspec.to_builtins(config.controller_parameters)
    for levels in range(MAX_KEY_LEVELS, 0, -1):
        settings: dict[str, str] = {}
        for section, value in value_by_section.items():
            _add_settings(settings, section, value, levels)
        if len(settings) <= MAX_SHARED_SETTINGS:
            return settings
    return {section: _compute_short_hash(value) for section, value in value_by_section.items()}


def _collect_robot_settings(robot: RobotFile) -> dict[str, Any]:
    """Return a robot file without the abilities of its drives."""
    table: dict[str, Any] = msgspec.to_builtins(robot)
    for ability in DRIVE_ABILITIES:
        table["drive"].pop(ability)
    exceptions: dict[str, Any] = {}
    for joint, values in table["joints"].items():
        shared_values = {
            key: value
            for key, value in values.items()
            if value is not None and key not in DRIVE_ABILITIES
        }
        if shared_values:
            exceptions[joint] = shared_values
    table["joints"] = exceptions
    return table


def _add_settings(settings: dict[str, str], key: str, value: Any, levels: int) -> None:
    """Add a value, or the values in a table, to settings, in place.

    An empty table adds nothing, so that a key in only one of two tables is the only difference.

    Args:
        settings: Settings to add to, by dotted key.
        key: Dotted key of the value.
        value: Value or table, as built-in types.
        levels: Maximum number of parts of a key. Deeper tables are added as one value.
    """
    if isinstance(value, dict):
        children = {f"{key}.{name}": child for name, child in value.items()}
        if key.count(".") + 1 < levels and all(
            len(child_key) <= MAX_KEY_LENGTH for child_key in children
        ):
            for child_key, child in children.items():
                _add_settings(settings, child_key, child, levels)
            return
    text: str = value if isinstance(value, str) and value else json.dumps(value, sort_keys=True)
    settings[key] = text if len(text) <= MAX_VALUE_LENGTH else _compute_short_hash(value)


def _compute_short_hash(value: Any) -> str:
    plain = json.dumps(value, sort_keys=True)
    return hashlib.sha256(plain.encode()).hexdigest()[:HASH_DIGITS]
