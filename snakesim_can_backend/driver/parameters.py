"""Module parameters from a robot file, and checks that modules and protocol support that file."""

from collections.abc import Mapping

from snakesim_can_backend.bus.load import ReportSchedule
from snakesim_can_backend.protocol.codec import load_layouts
from snakesim_can_backend.protocol.definitions import ModuleParameter, Opcode, SafeMotion
from snakesim_can_backend.settings import CanSettings
from snakesim_hal.base.errors import BackendError, ConfigError
from snakesim_hal.model.joints import Drive, Joint
from snakesim_hal.model.robot import RobotFile
from snakesim_hal.model.scenario import RunConfig

MIN_PERIODS = 2.2  # in a watchdog's time: one setpoint may be lost, and the next be a little late
SPEED_ROOM = 1.2  # a load may turn a joint faster than its motor, and the bus must still represent that


def plan_parameters(
    robot: RobotFile, settings: CanSettings, reports: ReportSchedule
) -> dict[int, dict[ModuleParameter, float]]:
    """The parameters to write to each node."""
    safe = SafeMotion.DAMP if robot.safety.action == "damp" else SafeMotion.PASSIVE
    common = {
        ModuleParameter.WATCHDOG: settings.watchdog_s,
        ModuleParameter.STOP_MODE: float(safe),
        ModuleParameter.CONTACT_EVERY: float(reports.contact_every),
        ModuleParameter.IMU_EVERY: float(reports.imu_every),
    }
    found: dict[int, dict[ModuleParameter, float]] = {}
    for node, joint in enumerate(robot.joint_table, start=1):
        motor, gear = joint.motor, joint.drive.gear
        found[node] = {
            ModuleParameter.STIFFNESS: motor.stiffness_nm_per_rad / gear**2,
            ModuleParameter.DAMPING: motor.damping_nm_s_per_rad / gear**2,
            ModuleParameter.VELOCITY_GAIN: motor.velocity_gain_nm_s_per_rad / gear**2,
            ModuleParameter.TORQUE_LIMIT: joint.limits.torque_nm / gear,
            ModuleParameter.SPEED_LIMIT: joint.limits.speed_rad_s * gear,
            ModuleParameter.ANGLE_LIMIT: _furthest_rad(joint),  # the limiter keeps to the nearer side
            **common,
            ModuleParameter.TAIL: float(node == 1 and reports.tail),
        }
    return found


def _furthest_rad(joint: Joint) -> float:
    """Of the module's shaft, from its own zero."""
    drive = joint.drive
    ends = (drive.zero_rad + drive.sign * drive.gear * end for end in (joint.limits.lower_rad, joint.limits.upper_rad))
    return max(map(abs, ends))


def check_drives(robot: RobotFile, settings: CanSettings) -> None:
    """Raise ConfigError for joints whose `[drive]` is not how this backend finds modules."""
    for number, joint in enumerate(robot.joint_table, start=1):
        if joint.id != number:
            raise ConfigError(
                f"robot {robot.name!r}: `joints.{joint.name}.id` = {joint.id}: modules on CAN have their joint's "
                f"number as node id, here {number}; give the module that one, and leave `id` out"
            )
        if joint.limits.cable_turns is not None:
            raise ConfigError(
                f"robot {robot.name!r}: `cable_turns` of {joint.name}: modules on CAN say angles up to 3.2767 rad, so "
                f"turns cannot be counted; give the joint end stops, and leave `cable_turns` out"
            )
        if joint.drive.port and joint.drive.port not in settings.channels:
            raise ConfigError(
                f"robot {robot.name!r}, {joint.name}: `port` = {joint.drive.port!r} is not among "
                f"`backends.can.channels` = {settings.channels}"
            )


def check_ratings(robot: RobotFile, in_force: Mapping[int, Mapping[ModuleParameter, float]] | None = None) -> None:
    """Raise ConfigError or BackendError when the robot file exceeds the protocol's range or a module's rating."""
    signals = load_layouts()[Opcode.JOINT_STATE].signals
    joints, hottest_c = robot.joint_table, load_layouts()[Opcode.HEALTH].signals["motor_temperature"].high
    for joint in joints:
        limits, gear = joint.limits, joint.drive.gear
        for what, value, most, unit in (
            ("limits.angle_rad", _furthest_rad(joint), signals["angle"].high, "rad"),
            ("limits.speed_rad_s", limits.speed_rad_s * gear, signals["velocity"].high / SPEED_ROOM, "rad/s"),
            ("limits.torque_nm", limits.torque_nm / gear, signals["torque"].high, "N·m"),
            ("limits.stop_at_c", limits.stop_at_c, hottest_c, "°C"),
        ):
            if value > most:
                behind = "" if joint.drive == Drive() else " at the module's shaft, by `gear` and `zero_rad`,"
                raise ConfigError(
                    f"robot {robot.name!r}, {joint.name}: `{what}` = {value} {unit}{behind} exceeds the range of the "
                    f"bus protocol, which ends at {most:.3g} {unit}"
                )
    reach_m = max(robot.link_lengths_m) + robot.module.radius_m
    along_m = load_layouts()[Opcode.CONTACT].signals["along"].high
    if robot.sensors.contacts is not None and reach_m > along_m:
        raise ConfigError(
            f"robot {robot.name!r}: a contact at a link's end, {reach_m:.3g} m from its joint (`module.length_m` + "
            f"`module.radius_m`), exceeds the range of the bus protocol, which ends at {along_m:.3g} m"
        )
    if robot.safety.action == "hold":
        raise ConfigError(
            f'robot {robot.name!r}: `safety.action` = "hold" is not supported by joint modules: servos '
            f'that hold stiffly overheat. Use "damp" or "passive"'
        )
    for node, values in (in_force or {}).items():
        for parameter, asked, unit in (
            (ModuleParameter.RATED_TORQUE, joints[node - 1].limits.torque_nm / joints[node - 1].drive.gear, "N·m"),
            (ModuleParameter.RATED_SPEED, joints[node - 1].limits.speed_rad_s * joints[node - 1].drive.gear, "rad/s"),
        ):
            if not values[parameter] >= asked * 0.999:  # also rejects a rating of NaN, which the bus can carry
                raise BackendError(
                    f"joint_{node} is rated for {values[parameter]:.3g} {unit}, robot {robot.name!r} needs "
                    f"{asked:g}: lower the limit in the robot file"
                )


def check_watchdog(config: RunConfig, settings: CanSettings) -> None:
    """Raise ConfigError if one lost setpoint would stop the modules."""
    min_s = MIN_PERIODS / config.rate_hz
    if settings.watchdog_s < min_s:
        min_rate_hz = MIN_PERIODS / settings.watchdog_s
        raise ConfigError(
            f"`backends.can.watchdog_s` = {settings.watchdog_s:g} s at `rate_hz` = {config.rate_hz:g}: one lost "
            f"setpoint would stop the modules; give them {min_s:.3g} s or more, or a rate from {min_rate_hz:.0f} Hz on"
        )
