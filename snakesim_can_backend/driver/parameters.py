"""Plans the modules' parameters from a robot file, and checks that modules and protocol support that file."""

from collections.abc import Iterator, Mapping

from snakesim_can_backend.bus.load import ReportSchedule
from snakesim_can_backend.protocol.codec import load_layouts
from snakesim_can_backend.protocol.definitions import ModuleParameter, Opcode, SafeMotion
from snakesim_can_backend.settings import CanSettings
from snakesim_hal.base.errors import BackendError, ConfigError
from snakesim_hal.model.robot_file.joints import Joint, JointDrive
from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_hal.model.scenario import RunConfig

# In a watchdog's time: one setpoint may be lost, and the next be a little late.
MIN_WATCHDOG_PERIODS = 2.2
# A load may turn a joint faster than its motor, and the bus must still represent that.
SPEED_RANGE_FACTOR = 1.2
RATING_TOLERANCE = 0.999  # a rating has single precision on the bus


def plan_parameters(
    robot: RobotFile, settings: CanSettings, reports: ReportSchedule
) -> dict[int, dict[ModuleParameter, float]]:
    """Compute the parameters that each module gets in bring-up, converted from the joint to the module's shaft.

    Args:
        robot: Robot file, with gains, limits and gears of the joints.
        settings: Settings of the backend.
        reports: Which reports the modules send, and how often.

    Returns:
        The parameters of each module, by node id.
    """
    stop_mode = SafeMotion.DAMP if robot.safety.action == "damp" else SafeMotion.PASSIVE
    parameters_by_node: dict[int, dict[ModuleParameter, float]] = {}
    for node, joint in enumerate(robot.joint_table, start=1):
        motor = joint.motor
        gear = joint.drive.gear
        sends_tail_contact = node == 1 and reports.tail
        parameters_by_node[node] = {
            ModuleParameter.STIFFNESS: motor.stiffness_nm_per_rad / gear**2,
            ModuleParameter.DAMPING: motor.damping_nm_s_per_rad / gear**2,
            ModuleParameter.VELOCITY_GAIN: motor.velocity_gain_nm_s_per_rad / gear**2,
            ModuleParameter.TORQUE_LIMIT: joint.limits.torque_nm / gear,
            ModuleParameter.SPEED_LIMIT: joint.limits.speed_rad_s * gear,
            ModuleParameter.ANGLE_LIMIT: _max_shaft_angle_rad(
                joint
            ),  # the limiter keeps to the nearer side
            ModuleParameter.WATCHDOG: settings.watchdog_s,
            ModuleParameter.STOP_MODE: float(stop_mode),
            ModuleParameter.CONTACT_EVERY: float(reports.contact_every),
            ModuleParameter.IMU_EVERY: float(reports.imu_every),
            ModuleParameter.TAIL: float(sends_tail_contact),
        }
    return parameters_by_node


def _max_shaft_angle_rad(joint: Joint) -> float:
    """Return the largest angle of the module's shaft from its own zero, to either side."""
    drive = joint.drive
    joint_limits_rad = (joint.limits.lower_rad, joint.limits.upper_rad)
    return max(
        abs(drive.zero_rad + drive.sign * drive.gear * limit_rad) for limit_rad in joint_limits_rad
    )


def validate_joint_drives(robot: RobotFile, settings: CanSettings) -> None:
    """Check that node ids, ports and turns in the robot file are those that joint modules support.

    Args:
        robot: Robot file.
        settings: Settings of the backend, with its channels.

    Raises:
        ConfigError: A joint has another id than its number, counts turns, or names a port that is no channel.
    """
    for number, joint in enumerate(robot.joint_table, start=1):
        if joint.id != number:
            raise ConfigError(
                f"robot {robot.name!r}: `joints.{joint.name}.id` = {joint.id}: modules on CAN have their joint's "
                f"number as node id, here {number}; give the module that one, and leave `id` out",
                code="drive/unsupported-setting",
            )
        if joint.limits.cable_turns is not None:
            raise ConfigError(
                f"robot {robot.name!r}: `cable_turns` of {joint.name}: modules on CAN report angles up to 3.2767 rad, "
                f"so turns cannot be counted; give the joint end stops, and leave `cable_turns` out",
                code="drive/unsupported-setting",
            )
        if joint.drive.port and joint.drive.port not in settings.channels:
            raise ConfigError(
                f"robot {robot.name!r}, {joint.name}: `port` = {joint.drive.port!r} is not among "
                f"`backends.can.channels` = {settings.channels}",
                code="bus/invalid-channel",
            )


def validate_ratings(
    robot: RobotFile, current_values: Mapping[int, Mapping[ModuleParameter, float]] | None = None
) -> None:
    """Check that the robot file stays within the protocol's ranges and the modules' ratings.

    Args:
        robot: Robot file.
        current_values: Current parameters of the modules, by node id; None if they are not known yet, so that ratings
            are not checked.

    Raises:
        ConfigError: The robot file exceeds a range of the protocol, or needs what no module supports.
        BackendError: The robot file exceeds the rating of a module.
    """
    for joint in robot.joint_table:
        _validate_protocol_ranges(robot, joint)
    _validate_contact_range(robot)
    if robot.safety.action == "hold":
        raise ConfigError(
            f'robot {robot.name!r}: `safety.action` = "hold" is not supported by joint modules: servos '
            f'that hold stiffly overheat. Use "damp" or "passive"',
            code="drive/unsupported-setting",
        )
    for node, values in (current_values or {}).items():
        _validate_module_ratings(robot, node, values)


def _validate_protocol_ranges(robot: RobotFile, joint: Joint) -> None:
    """Raise ConfigError if a limit of a joint exceeds the range of the bus protocol."""
    for key, value, max_value, unit in _list_limits_at_shaft(joint):
        if value > max_value:
            has_default_drive = joint.drive == JointDrive()
            place = "" if has_default_drive else " at the module's shaft, by `gear` and `zero_rad`,"
            raise ConfigError(
                f"robot {robot.name!r}, {joint.name}: `{key}` = {value} {unit}{place} exceeds the range of the "
                f"bus protocol, which ends at {max_value:.3g} {unit}",
                code="drive/unsupported-setting",
            )


def _list_limits_at_shaft(joint: Joint) -> Iterator[tuple[str, float, float, str]]:
    """Yield key, value, largest value on the bus and unit of every limit of a joint."""
    layouts = load_layouts()
    state = layouts[Opcode.JOINT_STATE].signals
    max_winding_c = layouts[Opcode.HEALTH].signals["motor_temperature"].high
    limits = joint.limits
    gear = joint.drive.gear
    yield "limits.angle_rad", _max_shaft_angle_rad(joint), state["angle"].high, "rad"
    yield (
        "limits.speed_rad_s",
        limits.speed_rad_s * gear,
        state["velocity"].high / SPEED_RANGE_FACTOR,
        "rad/s",
    )
    yield "limits.torque_nm", limits.torque_nm / gear, state["torque"].high, "N·m"
    yield "limits.stop_at_c", limits.stop_at_c, max_winding_c, "°C"


def _validate_contact_range(robot: RobotFile) -> None:
    """Raise ConfigError if a contact at the end of a link would be further away than the protocol can represent."""
    max_distance_m = max(robot.link_lengths_m) + robot.module.radius_m
    max_along_m = load_layouts()[Opcode.CONTACT].signals["along"].high
    if robot.sensors.contacts is not None and max_distance_m > max_along_m:
        raise ConfigError(
            f"robot {robot.name!r}: a contact at a link's end, {max_distance_m:.3g} m from its joint "
            f"(`module.length_m` + `module.radius_m`), exceeds the range of the bus protocol, which ends at "
            f"{max_along_m:.3g} m",
            code="drive/unsupported-setting",
        )


def _validate_module_ratings(
    robot: RobotFile, node_id: int, values: Mapping[ModuleParameter, float]
) -> None:
    """Raise BackendError if the robot file needs more torque or speed than a module is rated for."""
    joint = robot.joint_table[node_id - 1]
    gear = joint.drive.gear
    for parameter, required_value, unit in (
        (ModuleParameter.RATED_TORQUE, joint.limits.torque_nm / gear, "N·m"),
        (ModuleParameter.RATED_SPEED, joint.limits.speed_rad_s * gear, "rad/s"),
    ):
        # False for NaN, which the bus can carry.
        is_sufficient = values[parameter] >= required_value * RATING_TOLERANCE
        if not is_sufficient:
            raise BackendError(
                f"joint_{node_id} is rated for {values[parameter]:.3g} {unit}, robot {robot.name!r} needs "
                f"{required_value:g}: lower the limit in the robot file",
                code="drive/unsupported-setting",
            )


def validate_watchdog(config: RunConfig, settings: CanSettings) -> None:
    """Raise ConfigError if one lost setpoint would stop the modules."""
    min_watchdog_s = MIN_WATCHDOG_PERIODS / config.rate_hz
    if settings.watchdog_s < min_watchdog_s:
        min_rate_hz = MIN_WATCHDOG_PERIODS / settings.watchdog_s
        raise ConfigError(
            f"`backends.can.watchdog_s` = {settings.watchdog_s:g} s at `rate_hz` = {config.rate_hz:g}: one lost "
            f"setpoint would stop the modules; give them {min_watchdog_s:.3g} s or more, or a rate from "
            f"{min_rate_hz:.0f} Hz on",
            code="drive/watchdog-too-short",
        )
