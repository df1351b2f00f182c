"""Checks before a run that all plugins of its configuration are installed, and that their sections are valid."""

from collections.abc import Sequence
from typing import Any

import msgspec

from snakesim_hal.backend import Backend
from snakesim_hal.base.errors import ConfigError, shorten
from snakesim_hal.controller import Controller, decode_parameters
from snakesim_hal.model.fault_kinds import CONTROL
from snakesim_hal.model.fault_plan import parse_and_validate_planned_faults
from snakesim_hal.model.files import ConfigTable
from snakesim_hal.model.plugins import (
    BACKENDS,
    CONTROLLERS,
    SERVICES,
    decode_plugin_settings,
    load_plugin,
    load_plugin_unless_file,
    require_base_class,
)
from snakesim_hal.model.robot_file.robot import describe_joints
from snakesim_hal.model.scenario import RunConfig, describe_run_robot
from snakesim_hal.service import Service
from snakesim_hal.wire.messages import JointDescription, JointMode

GUIDANCE = "guidance"
POSE_SERVICES = {GUIDANCE, "navigation"}  # of no use without a pose of the robot


def validate_and_complete_config(
    config: RunConfig, table: ConfigTable | None = None, *, load_file_plugins: bool = True
) -> RunConfig:
    """Check that everything that a run needs is installed and fits its settings, and complete the configuration.

    Args:
        config: Configuration of the run.
        table: Values of the configuration with their origins, for error messages. None if they are not known.
        load_file_plugins: If False, no code of a `./file.py:Class` is run. Its existence is still checked, but not its
            settings, and the clock mode stays as it is if the backend is such a file.

    Returns:
        The configuration, limited to the control modes of the backend, without services that the controller does not
        need, and with a clock mode that the backend supports. A scenario may name another clock mode, because it is
        written for any backend.

    Raises:
        ConfigError: A plugin is missing, or does not fit its settings or the robot.
    """
    source = table.source if table is not None else f"scenario {config.name!r}"
    # Both raise ConfigError for a missing plugin. The second one returns None instead of running the code of a file.
    load = load_plugin if load_file_plugins else load_plugin_unless_file
    # The order matters: the backend limits the control modes of the robot, by which the controller is checked, and the
    # controller may leave out services, which are checked afterwards.
    backend_class = _load_backend_class(config.backend, load_file_plugins=load_file_plugins)
    if backend_class is not None:
        config = apply_backend_modes(config, backend_class)
    controller_plugin = load(CONTROLLERS, config.controller)
    if controller_plugin is not None:
        label = f"controller {shorten(config.controller)!r}"
        controller_class = require_base_class(controller_plugin, Controller, label)
        config = _validate_controller_and_leave_out_services(
            config, controller_class, source, table
        )
    for service_name in config.internal_services:
        plugin_name = _get_service_plugin_name(config, service_name)
        service_plugin = load(SERVICES, plugin_name)
        if service_plugin is not None:
            _validate_service_class(config, service_name, plugin_name, service_plugin)
    _validate_in_host_services(config, source)
    parse_and_validate_planned_faults(config, table)
    return validate_backend_config(config, table, load_file_plugins=load_file_plugins)


def _validate_controller_and_leave_out_services(
    config: RunConfig, controller: type[Controller[Any]], source: str, table: ConfigTable | None
) -> RunConfig:
    """Check a controller's parameters and what it needs of the robot.

    Args:
        config: Configuration of the run.
        controller: Class of the controller.
        source: File of the configuration, for error messages.
        table: Values of the configuration with their origins. None if they are not known.

    Returns:
        The configuration without services that this controller does not need.

    Raises:
        ConfigError: A parameter is wrong, or the robot does not have a required control mode or measurement.
    """
    origin_by_key = table.origin_by_key if table is not None else None
    parameters = decode_parameters(
        controller, config.controller_parameters, source, config.control_section, origin_by_key
    )
    config = _leave_out_pose_services(config, controller)
    problem = find_missing_capability(describe_joints(config.robot), controller, config.controller)
    if problem is not None:
        raise ConfigError(f"robot {config.robot.name!r}: {problem}", code="config/conflict")
    controller.check(describe_run_robot(config), parameters)
    return config


def _validate_in_host_services(config: RunConfig, source: str) -> None:
    """Raise ConfigError if a service other than control is configured to run in the process of the host."""
    unsupported = [name for name in config.in_host_services if name != CONTROL]
    if unsupported:
        raise ConfigError(
            f'{source}: `services.{unsupported[0]}.process` = "host": only control may run in the host, '
            'because other services would delay its control cycle; leave it at "own"',
            code="config/conflict",
        )


def load_service_class(config: RunConfig, name: str) -> type[Service]:
    """Load the class of a service. The code of a `./file.py:Class` is run.

    Args:
        config: Configuration of the run, which may name a plugin for the service.
        name: Name of the service.

    Raises:
        ConfigError: The class is not found, or is not the class of a service of this name.
    """
    plugin_name = _get_service_plugin_name(config, name)
    service = load_plugin(SERVICES, plugin_name)
    _validate_service_class(config, name, plugin_name, service)
    return service


def _get_service_plugin_name(config: RunConfig, name: str) -> str:
    """Return the name of the plugin for a service: the configured one, or else the name of the service."""
    section = config.services.get(name)
    if section is not None and section.plugin:
        return section.plugin
    return name


def _validate_service_class(config: RunConfig, name: str, plugin_name: str, service: Any) -> None:
    """Raise ConfigError if a plugin is not a service class, or has another service name than its section."""
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


def load_backend_class(name: str) -> type[Backend]:
    """Load the class of a backend: an installed one, or a `./file.py:Class`, whose code is run.

    Raises:
        ConfigError: The class is not found, or is not the class of a backend.
    """
    plugin = load_plugin(BACKENDS, name)
    require_base_class(plugin, Backend, f"backend {shorten(name)!r}")
    return plugin


def _load_backend_class(name: str, *, load_file_plugins: bool) -> type[Backend] | None:
    """Load the class of a backend. Return None for a class in a file whose code must not be run."""
    if not load_file_plugins and load_plugin_unless_file(BACKENDS, name) is None:
        return None
    return load_backend_class(name)


def find_missing_capability(
    joints: Sequence[JointDescription], controller: type[Controller[Any]], name: str
) -> str | None:
    """Find a control mode or measurement that a controller requires and a joint of the robot does not have.

    Args:
        joints: Descriptions of the robot's joints.
        controller: Class of the controller. Its `required_modes` and `required_measurements` apply to every joint.
        name: Name of the controller, for the message.

    Returns:
        An error message about the first such joint, or None if every joint has all that is required.
    """
    for joint in joints:
        for mode in controller.required_modes:
            if not joint.supports_mode(mode):
                available = [
                    mode.name.lower() for mode in joint.modes if mode is not JointMode.PASSIVE
                ]
                return (
                    f"controller {name!r} needs {mode.name.lower()} mode of every joint, and {joint.name} has "
                    f"{', '.join(available)}. Choose another controller or scenario. If the drives have this mode, "
                    f"correct `modes` in [drive] or [joints.{joint.name}] of the robot file"
                )
        for measurement in controller.required_measurements:
            if measurement not in joint.measures:
                return (
                    f"controller {name!r} needs the measured {measurement} of every joint, and {joint.name} does not "
                    f"measure it. Choose another controller; or correct `measures` in [drive] or "
                    f"[joints.{joint.name}] of the robot file"
                )
    return None


def _leave_out_pose_services(config: RunConfig, controller: type[Controller[Any]]) -> RunConfig:
    """Return the configuration without guidance and navigation if the controller does not need them, and has no pose.

    This concerns a controller of joints on a robot without a pose sensor. The services stay if the scenario requires
    dead reckoning itself, or has further services.
    """
    # A scenario that requires dead reckoning names it as its localization.
    uses_dead_reckoning = config.uses_dead_reckoning(describe_run_robot(config))
    if not uses_dead_reckoning or config.mission.localization != "pose_sensor":
        return config
    services = config.internal_services.keys()
    if GUIDANCE not in services or not services <= {*POSE_SERVICES, CONTROL}:
        return config
    if controller.needs_world:
        return config
    remaining = {
        name: service for name, service in config.services.items() if name not in POSE_SERVICES
    }
    return msgspec.structs.replace(config, services=remaining)


def apply_backend_modes(config: RunConfig, backend: type[Backend]) -> RunConfig:
    """Return the configuration with a robot whose joints have only the control modes that a backend supports."""
    robot = backend.limit_modes(config.robot)
    if robot is config.robot:
        return config
    return msgspec.structs.replace(config, robot=robot)


def decode_backend_settings(
    config: RunConfig, backend: type[Backend], table: ConfigTable | None = None
) -> Any:
    """Return the scenario's [backends.<name>] section, checked by the backend's own Struct. Raises ConfigError."""
    source = f"scenario {config.name!r}" if table is None else table.source
    origin = None if table is None else table.origin_by_key
    return decode_plugin_settings(
        backend, config.backend_settings, source, config.backend_section, origin
    )


def validate_backend_config(
    config: RunConfig, table: ConfigTable | None = None, *, load_file_plugins: bool = True
) -> RunConfig:
    """Check and complete the part of a configuration that concerns the backend, and thus a computer with only a host.

    Args:
        config: Configuration of the run.
        table: Values of the configuration with their origins, for error messages. None if they are not known.
        load_file_plugins: If False, no code of a `./file.py:Class` is run. Such a backend is not checked then.

    Returns:
        The configuration, limited to the control modes of the backend, and with a clock mode that it supports.

    Raises:
        ConfigError: The backend is missing, its settings are wrong, or a flag requests a clock mode that it does not
            support.
    """
    backend = _load_backend_class(config.backend, load_file_plugins=load_file_plugins)
    if backend is None:
        return config
    settings = decode_backend_settings(config, backend, table)
    config = apply_backend_modes(config, backend)
    clock_modes = backend.check(config, settings)
    if config.clock_mode in clock_modes:
        return config
    origin = table.find_origin("clock_mode") if table is not None else f"scenario {config.name!r}"
    if origin.startswith("--"):
        raise ConfigError(
            f"{origin}: backend {config.backend!r} cannot keep this clock mode, only {' or '.join(clock_modes)}",
            code="backend/wrong-clock-mode",
        )
    return msgspec.structs.replace(config, clock_mode=clock_modes[0])
