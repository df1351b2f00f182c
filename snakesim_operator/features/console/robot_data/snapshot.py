"""What the console shows of one instant of a robot, live or recorded."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from snakesim_hal.model.kinematics import quaternion_from_yaw
from snakesim_hal.model.robot import describe
from snakesim_hal.model.scenario import RunConfig, config_hash, start_of
from snakesim_hal.wire.messages import (
    AppliedCommand,
    ColorImage,
    Configuration,
    Contacts,
    ControlSettings,
    ControlState,
    DepthImage,
    Description,
    Imu,
    JointState,
    OwnSample,
    Power,
    Status,
    Trajectory,
    World,
)
from snakesim_hal.wire.quantities import Quaternion, Vector


@dataclass(frozen=True)
class Stream:
    """One key: how many messages a second arrive, and how old its data is in robot time (None: it has no stamp)."""

    rate_hz: float
    age_s: float | None


@dataclass(frozen=True, kw_only=True)
class RobotSnapshot:
    """One instant. Whatever is None is not known."""

    robot: Description
    expected: bool = False  # not a robot's: its run is starting
    time_s: float | None = None  # robot time
    silent_s: float = 0.0  # since the host was heard
    status: Status | None = None
    joints: JointState | None = None  # the newest
    body: JointState | None = None  # of the instant of `base`
    base: tuple[Vector, Quaternion] | None = None  # position_w and orientation wxyz of the tail end
    world: World | None = None
    contacts: Contacts | None = None
    trajectory: Trajectory | None = None
    control: ControlState | None = None
    applied: AppliedCommand | None = None
    settings: ControlSettings | None = None
    configuration: Configuration | None = None
    power: Power | None = None
    imu: Imu | None = None
    images: dict[str, DepthImage | ColorImage] = field(default_factory=dict)  # by key
    own: dict[str, OwnSample] = field(default_factory=dict[str, OwnSample])  # of own sensors, by key
    streams: dict[str, Stream] = field(default_factory=dict)  # by key
    log: Sequence[str] = ()  # of a recording: what had become of the robot by then, newest first
    hosts: frozenset[str] = frozenset()  # ids of all that publish a status; more than one: an impostor


def expected_snapshot(config: RunConfig) -> RobotSnapshot:
    """The robot of a run that is starting, as its scenario places it on flat ground."""
    robot = describe(
        config.robot,
        backend=config.backend,
        period_ns=config.period_ns,
        lease_ns=config.lease_ns,
        config_hash=config_hash(config),
    )
    start = start_of(config)
    zero = [0.0] * len(robot.joints)
    joints = JointState(
        tick=0,
        timestamp_ns=0,
        angle_rad=start.angles_rad.tolist(),
        velocity_rad_s=zero,
        torque_nm=zero,
        valid=[True] * len(zero),
        age_ns=[0] * len(zero),
    )
    base = (*start.position_w, config.robot.module.radius_m), quaternion_from_yaw(start.yaw_rad)
    return RobotSnapshot(robot=robot, expected=True, joints=joints, body=joints, base=base)
