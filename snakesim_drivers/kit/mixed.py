"""The backend `mixed`: a robot with drives of several types, such as a head of servos on ODrive axes.

The robot file names the driver type of each joint in `driver`, and each driver type has its own section in the
scenario. What concerns the whole robot is in `[backends.mixed]`: motion capture, and the body that emulated drives
move together.
"""

from typing import Any

import msgspec

from snakesim_drivers.kit.drive_settings import BodySettings
from snakesim_drivers.kit.drive_type import BusesBackend, DriverTypeBackend, DriverTypePart
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.plugins import BACKENDS, decode_plugin_settings, load_plugin
from snakesim_hal.model.robot_file.joints import Joint, JointExceptions
from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_hal.model.scenario import RunConfig


class MixedSettings(BodySettings, frozen=True, kw_only=True):
    """The scenario's `[backends.mixed]` section."""


class MixedBackend(BusesBackend):
    """The backend on drives of several driver types, real or emulated."""

    Settings = MixedSettings
    name = "mixed"

    @classmethod
    def group_joints_by_driver_type(
        cls, config: RunConfig, settings: MixedSettings
    ) -> list[DriverTypePart]:
        """Return the joints of each driver type, with the settings of its section.

        Raises:
            ConfigError: A driver type is unknown, its section is wrong, or only some driver types have a bus.
        """
        driver_types = {
            joint.drive.driver: load_driver_type(config.robot, joint)
            for joint in config.robot.joint_table
        }
        parts = [
            _make_part(config, driver, driver_type) for driver, driver_type in driver_types.items()
        ]
        _validate_all_or_no_emulation(parts)
        return parts

    @classmethod
    def limit_modes(cls, robot: RobotFile) -> RobotFile:
        """Return the robot with only those modes and measurements that the driver type of each joint supports."""
        joints = dict(robot.joints)
        for joint in robot.joint_table:
            driver_type = load_driver_type(robot, joint)
            if driver_type.unmeasured:
                measures = [
                    quantity
                    for quantity in joint.drive.measures
                    if quantity not in driver_type.unmeasured
                ]
                exceptions = joints.get(joint.name, JointExceptions())
                joints[joint.name] = msgspec.structs.replace(exceptions, measures=measures)
            supported_modes = driver_type.supported_modes
            if supported_modes is not None:
                modes = [mode for mode in joint.drive.modes if mode in supported_modes]
                exceptions = joints.get(joint.name, JointExceptions())
                joints[joint.name] = msgspec.structs.replace(exceptions, modes=modes)
        return msgspec.structs.replace(robot, joints=joints)


def load_driver_type(robot: RobotFile, joint: Joint) -> type[DriverTypeBackend]:
    """Return the class of the driver type that the robot file names for a joint.

    Args:
        robot: Robot that the joint belongs to, for error messages.
        joint: Joint with the name of its driver type in `drive.driver`.

    Raises:
        ConfigError: The robot file names no driver type for the joint, an unknown one, or a backend that is none.
    """
    driver = joint.drive.driver
    context = f"robot {robot.name!r}, {joint.name}: `driver`"
    suggestion = f"set it in [joints.{joint.name}] of the robot file, or for all joints in [drive]"
    if not driver:
        raise ConfigError(
            f"{context} is missing, and the backend `mixed` drives each joint by its driver type: {suggestion}",
            code="drive/unknown-type",
        )
    try:
        plugin: Any = load_plugin(BACKENDS, driver)
    except ConfigError as error:
        raise ConfigError(
            f"{context} = {driver!r}: {error}; {suggestion}", code="drive/unknown-type"
        ) from None
    if not (isinstance(plugin, type) and issubclass(plugin, DriverTypeBackend)):
        raise ConfigError(
            f"{context} = {driver!r}, which is a backend of whole robots, and not a driver type; {suggestion}",
            code="drive/unknown-type",
        )
    return plugin


def _make_part(
    config: RunConfig, driver: str, driver_type: type[DriverTypeBackend]
) -> DriverTypePart:
    """Return the joints of a driver type, and its settings from the scenario.

    Raises:
        ConfigError: The section of the driver type is invalid, or sets a key that concerns the whole robot to another
            value than `[backends.mixed]`.
    """
    name = driver.rpartition(":")[2]  # for `./file.py:Servo` the section is `backends.Servo`
    section = f"backends.{name}"
    section_values = config.backends.get(name, {})
    robot_wide_values = config.backends.get(MixedBackend.name, {})
    contradicting_keys = sorted(
        key
        for key in section_values.keys() & {*BodySettings.__struct_fields__}
        if key not in robot_wide_values or section_values[key] != robot_wide_values[key]
    )
    if contradicting_keys:
        key = contradicting_keys[0]
        raise ConfigError(
            f"`{section}.{key}` is of a robot of {name} alone; of a mixed one it concerns all drives: set "
            f"`backends.mixed.{key}`, to the same value if you keep both",
            code="config/conflict",
        )
    settings = decode_plugin_settings(
        driver_type, section_values, f"scenario {config.name!r}", section
    )
    joints = {
        i: joint for i, joint in enumerate(config.robot.joint_table) if joint.drive.driver == driver
    }
    return DriverTypePart(driver_type, settings, section, joints)


def _validate_all_or_no_emulation(parts: list[DriverTypePart]) -> None:
    """Raise ConfigError if some drives are emulated here and others are on a bus."""
    on_bus = [part for part in parts if part.ports]
    emulated = [part for part in parts if not part.ports]
    if on_bus and emulated:
        raise ConfigError(
            f"`{emulated[0].section}` names no bus, and `{on_bus[0].section}` does: drives that are emulated here do "
            f"not move with those on a bus. Name the buses of all driver types, or of none",
            code="bus/not-virtual",
        )
