"""The backend `mixed`: a robot with drives of several types, such as a head of servos on ODrive axes.

The robot file says of each joint of what `driver` it is, and each driver type has its own section in the scenario.
What concerns the whole robot is in `[backends.mixed]`: motion capture, and the body that emulated drives move together.
"""

from collections.abc import Collection
from typing import Any

import msgspec

from snakesim_drivers.kit.drive_settings import BodySettings
from snakesim_drivers.kit.drive_type import DriverTypeBackend, DriverTypePart
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.joints import Joint, JointExceptions
from snakesim_hal.model.plugins import BACKENDS, find_plugin, plugin_settings
from snakesim_hal.model.robot import RobotFile
from snakesim_hal.model.scenario import RunConfig


class MixedSettings(BodySettings, frozen=True, kw_only=True):
    """The scenario's `[backends.mixed]` section."""


class MixedBackend(DriverTypeBackend):
    """A `snakesim_hal.backend.Backend` on drives of several driver types, real or emulated."""

    Settings, name = MixedSettings, "mixed"

    @classmethod
    def split_by_driver_type(cls, config: RunConfig, settings: MixedSettings) -> list[DriverTypePart]:
        """The joints of each driver type, with the settings of its section."""
        driver_types = {joint.drive.driver: find_driver_type(config.robot, joint) for joint in config.robot.joint_table}
        parts: list[DriverTypePart] = []
        for driver_type_name, driver_type in driver_types.items():
            name = driver_type_name.rpartition(":")[2]  # for `./file.py:Servo` the section is `backends.Servo`
            section, given = f"backends.{name}", config.backends.get(name, {})
            joints = {i: j for i, j in enumerate(config.robot.joint_table) if j.drive.driver == driver_type_name}
            if others := sorted(given.keys() & {*BodySettings.__struct_fields__}):
                raise ConfigError(
                    f"`{section}.{others[0]}` is of a robot of {name} alone; of a mixed one it concerns all drives: "
                    f"say `backends.mixed.{others[0]}`"
                )
            own = plugin_settings(driver_type, given, f"scenario {config.name!r}", section)
            parts.append(DriverTypePart(driver_type, own, section, joints))
        real = [part for part in parts if part.ports]
        if real and len(real) < len(parts):
            without = next(part for part in parts if not part.ports)
            raise ConfigError(
                f"`{without.section}` names no bus, and `{real[0].section}` does: drives that are emulated here do not "
                f"move with those on a bus. Name the buses of all driver types, or of none"
            )
        return parts

    @staticmethod
    def as_driven(robot: RobotFile) -> RobotFile:
        """The robot with the modes that each joint has in its driver type, whatever else its file says."""
        joints = dict(robot.joints)
        for joint in robot.joint_table:
            known: Collection[str] | None = getattr(find_driver_type(robot, joint), "MODES", None)
            if known is not None:
                modes = [mode for mode in joint.drive.modes if mode in known]
                joints[joint.name] = msgspec.structs.replace(joints.get(joint.name, JointExceptions()), modes=modes)
        return msgspec.structs.replace(robot, joints=joints)


def find_driver_type(robot: RobotFile, joint: Joint) -> type[DriverTypeBackend]:
    """Of a joint. Raises ConfigError."""
    name = joint.drive.driver
    where = f"robot {robot.name!r}, {joint.name}: `driver`"
    fix = f"say it in [joints.{joint.name}] of the robot file, or for all joints in [drive]"
    if not name:
        raise ConfigError(f"{where} is not given, and the backend `mixed` drives each joint by its driver type: {fix}")
    try:
        found: Any = find_plugin(BACKENDS, name)
    except ConfigError as error:
        raise ConfigError(f"{where} = {name!r}: {error}; {fix}") from None
    if not (isinstance(found, type) and issubclass(found, DriverTypeBackend)) or issubclass(found, MixedBackend):
        raise ConfigError(
            f"{where} = {name!r}, a backend that drives whole robots, and no driver type of drives; {fix}"
        )
    return found
