"""A short form of the settings that the host and the services of a robot must share, to compare them between computers.

Each process reads its own copy of the scenario, perhaps from another checkout. Settings that only one process uses may
differ: the backend, the duration of a run, injected faults, and which process starts a service.
"""

import hashlib
import json
from typing import Any

import msgspec

from snakesim_hal.model.scenario import RunConfig

HASH_DIGITS = 12


def shared_settings(config: RunConfig) -> dict[str, str]:
    """Return the shared settings: by field, its value as text, or a hash of a section."""
    schedules = {name: (service.decimation, service.latency_ticks) for name, service in config.services.items()}
    return {
        "robot": f"{config.robot.name[:40]} {_hash(config.robot)}",
        "scene": f"{config.scene.name[:40]} {_hash(config.scene)}",
        "clock_mode": config.clock_mode,
        "rate_hz": f"{config.rate_hz:g}",
        "seed": str(config.seed),
        "start": _hash(config.start),
        "mission": _hash(config.mission),
        "services": _hash(schedules),
        "max_age": _hash(config.max_age),
        "controller": f"{config.controller.rpartition(':')[2][:40]} {_hash(config.controller_parameters)}",
    }


def _hash(section: Any) -> str:
    plain = json.dumps(msgspec.to_builtins(section), sort_keys=True)
    return hashlib.sha256(plain.encode()).hexdigest()[:HASH_DIGITS]
