"""One instant of a robot, live or recorded, with everything that the console shows of it."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from snakesim_hal.model.geometry.kinematics import quaternion_from_yaw
from snakesim_hal.model.robot_file.robot import describe_robot
from snakesim_hal.model.scenario import RunConfig, compute_config_hash, compute_start_pose
from snakesim_hal.wire.messages import (
    AppliedCommand,
    ColorImage,
    Contacts,
    ControlParameters,
    ControlState,
    CustomSample,
    DepthImage,
    Imu,
    JointState,
    Power,
    RobotDescription,
    RobotStatus,
    RunConfiguration,
    Trajectory,
    WorldModel,
)
from snakesim_hal.wire.quantities import Quaternion, Vector


@dataclass(frozen=True)
class MessageStream:
    """Rate and age of the messages of one key."""

    rate_hz: float
    age_s: float | None  # of the newest message, in robot time; None: the message has no timestamp


@dataclass(frozen=True, kw_only=True)
class RobotSnapshot:
    """One instant of a robot. None means that a value is not known."""

    robot: RobotDescription

    # Host.
    expected: bool = False  # True: the run is starting, and no host has described the robot yet
    time_s: float | None = None  # robot time
    time_since_status_s: float = 0.0  # since the newest status of the host arrived
    status: RobotStatus | None = None
    configuration: RunConfiguration | None = None
    # Ids of all hosts that publish a status; more than one: an impostor.
    hosts: frozenset[str] = frozenset()

    # Robot.
    joints: JointState | None = None  # the newest
    body: JointState | None = None  # of the instant of `base`
    base: tuple[Vector, Quaternion] | None = None  # position_w and orientation wxyz of the tail end
    contacts: Contacts | None = None
    applied: AppliedCommand | None = None
    power: Power | None = None
    imu: Imu | None = None
    images: dict[str, DepthImage | ColorImage] = field(default_factory=dict)  # by key
    # Of custom sensors, by key.
    custom: dict[str, CustomSample] = field(default_factory=dict[str, CustomSample])

    # Controller.
    world: WorldModel | None = None
    trajectory: Trajectory | None = None
    control: ControlState | None = None
    parameters: ControlParameters | None = None

    # Network and log.
    streams: dict[str, MessageStream] = field(default_factory=dict)  # by key
    log: Sequence[str] = ()  # of a recording: changes of the robot's state until then, newest first


def make_expected_snapshot(config: RunConfig) -> RobotSnapshot:
    """Make a snapshot of the robot of a run that is starting, as its scenario places it on flat ground.

    The page shows it until the host of the run describes itself.

    Args:
        config: Configuration of the run.
    """
    robot = describe_robot(
        config.robot,
        backend=config.backend,
        period_ns=config.period_ns,
        lease_ns=config.lease_ns,
        config_hash=compute_config_hash(config),
    )
    start_pose = compute_start_pose(config)
    zero_per_joint = [0.0] * len(robot.joints)
    joints = JointState(
        tick=0,
        timestamp_ns=0,
        angle_rad=start_pose.angles_rad.tolist(),
        velocity_rad_s=zero_per_joint,
        torque_nm=zero_per_joint,
        valid=[True] * len(robot.joints),
        age_ns=[0] * len(robot.joints),
    )
    position_w = (*start_pose.position_w, config.robot.module.radius_m)
    base = position_w, quaternion_from_yaw(start_pose.yaw_rad)
    return RobotSnapshot(robot=robot, expected=True, joints=joints, body=joints, base=base)
