"""Checks before a run that all plugins of its configuration are installed, and that their settings are valid."""

from collections.abc import Callable, Sequence
from typing import Any

import msgspec

from snakesim_hal.base.errors import ConfigError, shorten
from snakesim_hal.model.fault_plan import check_planned
from snakesim_hal.model.files import Table
from snakesim_hal.model.plugins import BACKENDS, CONTROLLERS, SERVICES, find_installed, find_plugin, plugin_settings
from snakesim_hal.model.robot import describe_joints, with_modes
from snakesim_hal.model.scenario import CONTROL, RunConfig, describe_run_robot
from snakesim_hal.wire.messages import JointDescription, Mode

GUIDANCE = "guidance"
POSE_SERVICES = {GUIDANCE, "navigation"}  # of no use without a pose of the robot
SERVICE_ATTRIBUTES = ("name", "urgent", "too_slow", "configure", "outputs", "silence", "pause")


def check_plugins(config: RunConfig, table: Table | None = None, *, run_files: bool = True) -> RunConfig:
    """Check that everything that a run needs is installed and agrees with its settings.

    Args:
        config: configuration of the run.
        table: the values with their origins, for messages.
        run_files: False runs no code of a `./file.py:Class`, so that its settings and its clock mode are not checked.

    Returns:
        The configuration, with a clock mode that the backend supports: a scenario is written for any backend.

    Raises:
        ConfigError: a plugin is missing, or does not agree with its settings or with the robot.
    """
    source = table.source if table is not None else f"scenario {config.name!r}"
    find = find_plugin if run_files else find_installed
    config = with_backend_modes(config, find(BACKENDS, config.backend))
    controller = find(CONTROLLERS, config.controller)
    if controller is not None:
        config = _check_controller(config, controller, source, table)
    for service in config.own_services:
        find_service(config, service, find)
    _check_in_host_services(config, source)
    check_planned(config, table)
    return check_backend(config, table, run_files=run_files)


def _check_controller(config: RunConfig, controller: Any, source: str, table: Table | None) -> RunConfig:
    """Check a controller's settings and what it needs of the robot. Returns the configuration that it runs in."""
    origin = table.origin if table is not None else None
    settings = plugin_settings(controller, config.control_settings, source, config.control_section, origin)
    config = _without_pose_services(config, controller)
    problem = describe_missing_capability(describe_joints(config.robot), controller, config.controller)
    if problem is not None:
        raise ConfigError(f"robot {config.robot.name!r}: {problem}", code="config/conflict")
    if hasattr(controller, "check"):
        controller.check(describe_run_robot(config), settings)
    return config


def _check_in_host_services(config: RunConfig, source: str) -> None:
    """Raise ConfigError when a service other than control is to run inside the host."""
    others = [name for name in config.beside if name != CONTROL]
    if others:
        raise ConfigError(
            f'{source}: `services.{others[0]}.place` = "host": beside the driver there is room for control alone, for '
            'what plans or looks would keep the host from its ticks; leave it at "process"',
            code="config/conflict",
        )


def find_service(config: RunConfig, name: str, find: Callable[[str, str], Any] = find_plugin) -> Any:
    """Find the class of a service: of the scenario, installed, or `./file.py:Class`.

    Args:
        config: configuration of the run.
        name: of the service.
        find: or `find_installed`, which returns None for a file, and runs no code of it.

    Raises:
        ConfigError: the class is not found, or is not that of a service.
    """
    section = config.services.get(name)
    code = (section.code if section is not None else "") or name
    service = find(SERVICES, code)
    if service is None:
        return None
    missing = [attribute for attribute in SERVICE_ATTRIBUTES if not hasattr(service, attribute)]
    if missing:
        raise ConfigError(
            f"service {shorten(code)!r} has no {', '.join(missing)}; write its class as in snakesim_hal/service.py, "
            "or derive it from Service there",
            code="plugin/not-loadable",
        )
    if section is not None and service.name != name:
        raise ConfigError(
            f"service {shorten(code)!r} calls itself {service.name!r}, but is that of "
            f"services.{shorten(name)}, and both "
            f"have one name. Write [services.{service.name}] with code = {shorten(code)!r}, or change the "
            "class's `name`",
            code="plugin/not-loadable",
        )
    return service


def describe_missing_capability(joints: Sequence[JointDescription], controller: Any, name: str) -> str | None:
    """Return the first joint, with the capability, that a controller needs and the robot does not have.

    Args:
        joints: of the robot.
        controller: its class; `MODES` and `MEASURES` name what it needs of every joint.
        name: of the controller, for the message.

    Returns:
        A message, or None if the robot has everything.
    """
    for joint in joints:
        for mode in getattr(controller, "MODES", ()):
            if not joint.supports_mode(mode):
                available = [mode.name.lower() for mode in joint.modes if mode is not Mode.PASSIVE]
                return (
                    f"controller {name!r} needs {mode.name.lower()} mode of every joint, and {joint.name} has "
                    f"{', '.join(available)}. Choose another controller; or correct `modes` in [drive] or "
                    f"[joints.{joint.name}] of the robot file"
                )
        for measured in getattr(controller, "MEASURES", ()):
            if measured not in joint.measures:
                return (
                    f"controller {name!r} needs the measured {measured} of every joint, and {joint.name} does not "
                    f"measure it. Choose another controller; or correct `measures` in [drive] or "
                    f"[joints.{joint.name}] of the robot file"
                )
    return None


def _without_pose_services(config: RunConfig, controller: Any) -> RunConfig:
    """Leave guidance and navigation out for a controller of joints, if the robot has no pose sensor.

    They stay if the scenario asks for dead reckoning itself, or has further services.
    """
    # A scenario that asks for dead reckoning names it as its localization.
    dead_reckons = config.dead_reckons(describe_run_robot(config))
    if not dead_reckons or config.mission.localization != "pose_sensor":
        return config
    services = config.own_services.keys()
    if GUIDANCE not in services or not services <= {*POSE_SERVICES, CONTROL}:
        return config
    if getattr(controller, "NEEDS", "world") != "joints":
        return config
    remaining = {name: service for name, service in config.services.items() if name not in POSE_SERVICES}
    return msgspec.structs.replace(config, services=remaining)


def with_backend_modes(config: RunConfig, backend: Any) -> RunConfig:
    """Return the configuration with the control modes that the joints have on a backend.

    These are all modes, unless the backend's class names them in `MODES`, or for each joint in `as_driven`.
    """
    if hasattr(backend, "as_driven"):
        return msgspec.structs.replace(config, robot=backend.as_driven(config.robot))
    modes = getattr(backend, "MODES", None)
    if modes is None:
        return config
    return msgspec.structs.replace(config, robot=with_modes(config.robot, modes))


def backend_settings(config: RunConfig, backend: Any, table: Table | None = None) -> Any:
    """Return the scenario's [backends.<name>] section, checked by the backend's own Struct. Raises ConfigError."""
    source = f"scenario {config.name!r}" if table is None else table.source
    origin = None if table is None else table.origin
    return plugin_settings(backend, config.backend_settings, source, config.backend_section, origin)


def check_backend(config: RunConfig, table: Table | None = None, *, run_files: bool = True) -> RunConfig:
    """Check the part of a configuration that concerns the backend: enough for a computer that runs only a host.

    Args:
        config: configuration of the run.
        table: the values with their origins, for messages.
        run_files: False runs no code of a `./file.py:Class`, which is not checked then.

    Returns:
        The configuration, with a clock mode that the backend supports.

    Raises:
        ConfigError: the backend is missing, its settings are wrong, or it does not support a requested clock mode.
    """
    find = find_plugin if run_files else find_installed
    backend = find(BACKENDS, config.backend)
    if backend is None:
        return config
    settings = backend_settings(config, backend, table)
    config = with_backend_modes(config, backend)
    clock_modes = backend.check(config, settings)
    if config.clock_mode in clock_modes:
        return config
    origin = table.origin_of("clock_mode") if table is not None else f"scenario {config.name!r}"
    if origin.startswith("--"):
        raise ConfigError(
            f"{origin}: backend {config.backend!r} cannot keep this clock mode, only {' or '.join(clock_modes)}",
            code="backend/wrong-clock-mode",
        )
    return msgspec.structs.replace(config, clock_mode=clock_modes[0])
