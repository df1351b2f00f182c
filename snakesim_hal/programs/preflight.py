"""Checks before a run that all plugins of its configuration are installed, and that their sections are valid."""

from collections.abc import Sequence
from typing import Any

import msgspec

from snakesim_hal.backend import Backend
from snakesim_hal.base.errors import ConfigError, shorten
from snakesim_hal.controller import Controller, decode_parameters
from snakesim_hal.model.fault_kinds import CONTROL
from snakesim_hal.model.fault_plan import check_planned
from snakesim_hal.model.files import Table
from snakesim_hal.model.plugins import (
    BACKENDS,
    CONTROLLERS,
    SERVICES,
    find_installed,
    find_plugin,
    plugin_settings,
    require_base_class,
)
from snakesim_hal.model.robot import describe_joints
from snakesim_hal.model.scenario import RunConfig, describe_run_robot
from snakesim_hal.service import Service
from snakesim_hal.wire.messages import JointDescription, Mode

GUIDANCE = "guidance"
POSE_SERVICES = {GUIDANCE, "navigation"}  # of no use without a pose of the robot


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
    backend = _find_backend(config.backend, run_files=run_files)
    if backend is not None:
        config = with_backend_modes(config, backend)
    plugin = find(CONTROLLERS, config.controller)
    if plugin is not None:
        controller = require_base_class(plugin, Controller, f"controller {shorten(config.controller)!r}")
        config = _check_controller(config, controller, source, table)
    for service in config.own_services:
        plugin_name = _service_plugin_name(config, service)
        service_type = find(SERVICES, plugin_name)
        if service_type is not None:
            _check_service(config, service, plugin_name, service_type)
    _check_in_host_services(config, source)
    check_planned(config, table)
    return check_backend(config, table, run_files=run_files)


def _check_controller(
    config: RunConfig, controller: type[Controller[Any]], source: str, table: Table | None
) -> RunConfig:
    """Check a controller's parameters and what it needs of the robot. Returns the configuration that it runs in."""
    origin = table.origin if table is not None else None
    parameters = decode_parameters(controller, config.controller_parameters, source, config.control_section, origin)
    config = _without_pose_services(config, controller)
    problem = describe_missing_capability(describe_joints(config.robot), controller, config.controller)
    if problem is not None:
        raise ConfigError(f"robot {config.robot.name!r}: {problem}", code="config/conflict")
    controller.check(describe_run_robot(config), parameters)
    return config


def _check_in_host_services(config: RunConfig, source: str) -> None:
    """Raise ConfigError when a service other than control is to run inside the host."""
    others = [name for name in config.in_host_services if name != CONTROL]
    if others:
        raise ConfigError(
            f'{source}: `services.{others[0]}.process` = "host": only control may run in the host, '
            'because other services would delay its control cycle; leave it at "own"',
            code="config/conflict",
        )


def find_service(config: RunConfig, name: str) -> type[Service]:
    """Find the class of a service: of the scenario, installed, or `./file.py:Class`, which is run.

    Args:
        config: configuration of the run.
        name: of the service.

    Raises:
        ConfigError: the class is not found, or is not that of a service.
    """
    plugin_name = _service_plugin_name(config, name)
    service = find_plugin(SERVICES, plugin_name)
    _check_service(config, name, plugin_name, service)
    return service


def _service_plugin_name(config: RunConfig, name: str) -> str:
    """Return the plugin name of a service."""
    section = config.services.get(name)
    if section is not None and section.plugin:
        return section.plugin
    return name


def _check_service(config: RunConfig, name: str, plugin_name: str, service: Any) -> None:
    """Raise ConfigError if a plugin is not the class of the service of this name."""
    require_base_class(service, Service, f"service {shorten(plugin_name)!r}")
    section = config.services.get(name)
    if section is not None and service.name != name:
        raise ConfigError(
            f"service {shorten(plugin_name)!r} calls itself {service.name!r}, but is that of "
            f"services.{shorten(name)}, and both "
            f"have one name. Write [services.{service.name}] with plugin = {shorten(plugin_name)!r}, or change the "
            "class's `name`",
            code="plugin/not-loadable",
        )


def find_backend(name: str) -> type[Backend]:
    """Find the class of a backend: an installed one, or `./file.py:Class`, which is run.

    Raises:
        ConfigError: the class is not found, or is not that of a backend.
    """
    plugin = find_plugin(BACKENDS, name)
    require_base_class(plugin, Backend, f"backend {shorten(name)!r}")
    return plugin


def _find_backend(name: str, *, run_files: bool) -> type[Backend] | None:
    """Find the class of a backend; None for that of a file that must not run."""
    if not run_files and find_installed(BACKENDS, name) is None:
        return None
    return find_backend(name)


def describe_missing_capability(
    joints: Sequence[JointDescription], controller: type[Controller[Any]], name: str
) -> str | None:
    """Return the first joint, with the capability, that a controller needs and the robot does not have.

    Args:
        joints: of the robot.
        controller: its class; `required_modes` and `required_measurements` name what it needs of every joint.
        name: of the controller, for the message.

    Returns:
        A message, or None if the robot has everything.
    """
    for joint in joints:
        for mode in controller.required_modes:
            if not joint.supports_mode(mode):
                available = [mode.name.lower() for mode in joint.modes if mode is not Mode.PASSIVE]
                return (
                    f"controller {name!r} needs {mode.name.lower()} mode of every joint, and {joint.name} has "
                    f"{', '.join(available)}. Choose another controller; or correct `modes` in [drive] or "
                    f"[joints.{joint.name}] of the robot file"
                )
        for measured in controller.required_measurements:
            if measured not in joint.measures:
                return (
                    f"controller {name!r} needs the measured {measured} of every joint, and {joint.name} does not "
                    f"measure it. Choose another controller; or correct `measures` in [drive] or "
                    f"[joints.{joint.name}] of the robot file"
                )
    return None


def _without_pose_services(config: RunConfig, controller: type[Controller[Any]]) -> RunConfig:
    """Leave guidance and navigation out for a controller of joints, if the robot has no pose sensor.

    They stay if the scenario requires dead reckoning itself, or has further services.
    """
    # A scenario that requires dead reckoning names it as its localization.
    uses_dead_reckoning = config.uses_dead_reckoning(describe_run_robot(config))
    if not uses_dead_reckoning or config.mission.localization != "pose_sensor":
        return config
    services = config.own_services.keys()
    if GUIDANCE not in services or not services <= {*POSE_SERVICES, CONTROL}:
        return config
    if controller.needs_world:
        return config
    remaining = {name: service for name, service in config.services.items() if name not in POSE_SERVICES}
    return msgspec.structs.replace(config, services=remaining)


def with_backend_modes(config: RunConfig, backend: type[Backend]) -> RunConfig:
    """Return the configuration with the control modes that the joints have on a backend."""
    robot = backend.limit_modes(config.robot)
    if robot is config.robot:
        return config
    return msgspec.structs.replace(config, robot=robot)


def backend_settings(config: RunConfig, backend: type[Backend], table: Table | None = None) -> Any:
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
    backend = _find_backend(config.backend, run_files=run_files)
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
