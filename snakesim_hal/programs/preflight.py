"""Everything that a configuration names is installed, and its settings are valid."""

from collections.abc import Callable, Sequence
from typing import Any

import msgspec

from snakesim_hal.base.errors import ConfigError, short
from snakesim_hal.model.fault_plan import check_planned
from snakesim_hal.model.files import Table
from snakesim_hal.model.plugins import BACKENDS, CONTROLLERS, SERVICES, find_installed, find_plugin, plugin_settings
from snakesim_hal.model.robot import described, with_modes
from snakesim_hal.model.scenario import CONTROL, RunConfig, description_of
from snakesim_hal.wire.messages import JointDescription, Mode

GUIDANCE = "guidance"
BY_POSE = {GUIDANCE, "navigation"}
SERVICE_HAS = ("name", "urgent", "too_slow", "configure", "outputs", "silence", "pause")


def check_plugins(config: RunConfig, table: Table | None = None, *, run_files: bool = True) -> RunConfig:
    """Everything that a run needs is installed and agrees with its settings. Raises ConfigError.

    Returns the configuration, with a clock mode that the backend can keep: a scenario is written for any backend.
    run_files: False runs no code of a `./file.py:Class`, so that its settings and its clock mode are not checked.
    """
    source = table.source if table is not None else f"scenario {config.name!r}"
    find = find_plugin if run_files else find_installed
    config = on_backend(config, find(BACKENDS, config.backend))
    controller = find(CONTROLLERS, config.controller)
    if controller is not None:
        origin = table.origin if table is not None else None
        settings = plugin_settings(controller, config.control_settings, source, config.control_section, origin)
        config = _with_what_it_needs(config, controller)
        if (lacks := what_it_lacks(described(config.robot), controller, config.controller)) is not None:
            raise ConfigError(f"robot {config.robot.name!r}: {lacks}")
        if hasattr(controller, "check"):
            controller.check(description_of(config), settings)
    for service in config.own_services:
        find_service(config, service, find)
    if others := [name for name in config.beside if name != CONTROL]:
        raise ConfigError(
            f'{source}: `services.{others[0]}.place` = "host": beside the driver there is room for control alone, for '
            'what plans or looks would keep the host from its ticks; leave it at "process"'
        )
    check_planned(config, table)
    return check_backend(config, table, run_files=run_files)


def find_service(config: RunConfig, name: str, find: Callable[[str, str], Any] = find_plugin) -> Any:
    """The class of a service: of the scenario, installed, or `./file.py:Class`. Raises ConfigError.

    find: or `find_installed`, which returns None for a file, and runs none of it.
    """
    section = config.services.get(name)
    code = (section.code if section is not None else "") or name
    service = find(SERVICES, code)
    if service is None:
        return None
    lacks = [part for part in SERVICE_HAS if not hasattr(service, part)]
    if lacks:
        raise ConfigError(
            f"service {short(code)!r} has no {', '.join(lacks)}; write its class as in snakesim_hal/service.py, "
            "or derive it from Service there"
        )
    if section is not None and service.name != name:
        raise ConfigError(
            f"service {short(code)!r} calls itself {service.name!r}, but is that of services.{short(name)}, and both "
            f"have one name. Write [services.{service.name}] with code = {short(code)!r}, or change the class's `name`"
        )
    return service


def what_it_lacks(joints: Sequence[JointDescription], controller: Any, name: str) -> str | None:
    """The first joint, and the capability, that a controller needs and does not find; None: it finds all."""
    for joint in joints:
        for mode in getattr(controller, "MODES", ()):
            if not joint.has(mode):
                has = ", ".join(one.name.lower() for one in joint.modes if one is not Mode.PASSIVE)
                return (
                    f"controller {name!r} needs {mode.name.lower()} mode of every joint, and {joint.name} has {has}. "
                    f"Choose another controller; or correct `modes` in [drive] or [joints.{joint.name}] of the robot "
                    f"file"
                )
        for measured in getattr(controller, "MEASURES", ()):
            if measured not in joint.measures:
                return (
                    f"controller {name!r} needs the measured {measured} of every joint, and {joint.name} does not "
                    f"measure it. Choose another controller; or correct `measures` in [drive] or "
                    f"[joints.{joint.name}] of the robot file"
                )
    return None


def _with_what_it_needs(config: RunConfig, controller: Any) -> RunConfig:
    """Where nobody tells the pose, a controller of joints runs alone; for any other guidance reckons it."""
    alone = GUIDANCE in config.own_services and config.own_services.keys() <= {*BY_POSE, CONTROL}
    # Nobody has asked for it.
    reckons = config.dead_reckons(description_of(config)) and config.mission.localization == "pose_sensor"
    if not (reckons and alone and getattr(controller, "NEEDS", "world") == "joints"):
        return config
    left = {name: service for name, service in config.services.items() if name not in BY_POSE}
    return msgspec.structs.replace(config, services=left)


def on_backend(config: RunConfig, backend: Any) -> RunConfig:
    """With the modes that joints have on a backend: all, unless its class names them in `MODES`, or each joint's."""
    if hasattr(backend, "as_driven"):
        return msgspec.structs.replace(config, robot=backend.as_driven(config.robot))
    modes = getattr(backend, "MODES", None)
    return config if modes is None else msgspec.structs.replace(config, robot=with_modes(config.robot, modes))


def backend_settings(config: RunConfig, backend: Any, table: Table | None = None) -> Any:
    """The scenario's [backends.<name>] section, checked by the backend's own Struct. Raises ConfigError."""
    source, origin = (f"scenario {config.name!r}", None) if table is None else (table.source, table.origin)
    return plugin_settings(backend, config.backend_settings, source, config.backend_section, origin)


def check_backend(config: RunConfig, table: Table | None = None, *, run_files: bool = True) -> RunConfig:
    """What of it concerns the backend: enough for a computer with nothing but that. Raises ConfigError."""
    backend = (find_plugin if run_files else find_installed)(BACKENDS, config.backend)
    if backend is None:
        return config
    settings = backend_settings(config, backend, table)
    config = on_backend(config, backend)
    paces = backend.check(config, settings)
    if config.clock_mode in paces:
        return config
    asked_by = table.origin_of("clock_mode") if table is not None else f"scenario {config.name!r}"
    if asked_by.startswith("--"):
        raise ConfigError(
            f"{asked_by}: backend {config.backend!r} cannot keep this clock mode, only {' or '.join(paces)}"
        )
    return msgspec.structs.replace(config, clock_mode=paces[0])
