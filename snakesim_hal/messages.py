"""The wire contract: every message that crosses Zenoh, as a frozen Struct with bounds.

Vectors run over all joints, tail to head, in the order of the description. Frames are name suffixes: `_w` world,
`_l` the link's own frame (x forward along the link, origin at its rear joint). Quaternions are wxyz.
A new field gets a default; a change of meaning gets a new version in `VERSIONS`.
"""

from enum import IntEnum
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from snakesim_hal import quantities as q

Pace = Literal["realtime", "lockstep", "free"]
LifecycleState = Literal["disarmed", "armed", "fault", "estop"]
LocomotionState = Literal["PowerOff", "Idle", "NotLocomoting", "Locomoting"]
SafeAction = Literal["passive", "damp", "hold"]
Reach = Literal["robot", "joint"]
Axis = Literal["yaw", "pitch"]


class Mode(IntEnum):
    """What a joint does with its target."""

    PASSIVE = 0  # motor off, target ignored
    POSITION = 1  # target in rad
    VELOCITY = 2  # target in rad/s
    TORQUE = 3  # target in N·m


class Message(msgspec.Struct, frozen=True):
    """Base of everything on the wire. Unknown fields are ignored, so that fields can be added."""


# --- sensors ---------------------------------------------------------------------------------------------------


class JointState(Message, frozen=True, kw_only=True):
    """`sensor/joints`: every joint at one instant."""

    tick: q.Tick
    stamp_ns: q.Nanoseconds
    angle_rad: q.Angles
    velocity_rad_s: q.AngularVelocities
    torque_nm: q.Torques
    valid: q.Flags
    age_ns: q.Ages


class Contact(Message, frozen=True, kw_only=True):
    """One touch of a link by something that is not the ground; all vectors in the link's frame."""

    link: q.LinkIndex
    obstacle: q.Name | None
    position_l: q.Vector
    normal_l: q.UnitVector  # from the obstacle into the body
    tangent_1_l: q.UnitVector  # across the normal, towards the head
    tangent_2_l: q.UnitVector
    force_l: q.ForceVector  # on the body
    torque_l: q.TorqueVector  # on the body about the contact point


class Contacts(Message, frozen=True, kw_only=True):
    """`sensor/contacts`: all touches at one instant; an empty list says that nothing is touched."""

    tick: q.Tick
    stamp_ns: q.Nanoseconds
    contacts: Annotated[list[Contact], Meta(max_length=q.MAX_CONTACTS)]


class Imu(Message, frozen=True, kw_only=True):
    """`sensor/imu`: one entry a link that carries an IMU, in the link's frame."""

    tick: q.Tick
    stamp_ns: q.Nanoseconds
    link: Annotated[list[q.LinkIndex], Meta(max_length=q.MAX_JOINTS + 1)]
    angular_velocity_rad_s: Annotated[list[q.AngularVelocityVector], Meta(max_length=q.MAX_JOINTS + 1)]
    acceleration_m_s2: Annotated[list[q.AccelerationVector], Meta(max_length=q.MAX_JOINTS + 1)]


class Pose(Message, frozen=True, kw_only=True):
    """`sensor/pose`: the base (tail end of link 0) as a motion-capture system gives it."""

    tick: q.Tick
    stamp_ns: q.Nanoseconds
    position_w: q.Vector
    orientation_wxyz: q.Quaternion
    velocity_w: q.VelocityVector
    angular_velocity_w: q.AngularVelocityVector


class Power(Message, frozen=True, kw_only=True):
    """`sensor/power`: what the joint modules say of their supply and their health, one entry a joint."""

    tick: q.Tick
    stamp_ns: q.Nanoseconds
    voltage_v: Annotated[list[q.Voltage], Meta(max_length=q.MAX_JOINTS)]
    current_a: Annotated[list[q.Current], Meta(max_length=q.MAX_JOINTS)]
    motor_c: Annotated[list[q.Temperature], Meta(max_length=q.MAX_JOINTS)]
    board_c: Annotated[list[q.Temperature], Meta(max_length=q.MAX_JOINTS)]
    leak: q.Flags
    valid: q.Flags


# --- actuators -------------------------------------------------------------------------------------------------


class JointCommand(Message, frozen=True, kw_only=True):
    """`actuator/joints`: what the lease holder wants of every joint.

    `target[i]` is in the unit of `mode[i]`. `torque_limit_nm[i]` bounds the motor below the robot's own limit.
    `tick` and `arming` are those of the clock that the command answers; what was sent before an arming does not count
    after it. `layout` is the hash from the description.
    """

    tick: q.Tick
    sequence: q.Tick
    lease_epoch: q.Tick
    layout: q.Name
    valid_for_ns: q.Nanoseconds
    mode: Annotated[list[Mode], Meta(max_length=q.MAX_JOINTS)]
    target: q.Targets
    torque_limit_nm: q.TorqueLimits | None = None
    arming: q.Tick | None = None  # None: the sender does not tell


class AppliedCommand(Message, frozen=True, kw_only=True):
    """`hal/applied`: what really went to the motors in a tick, and where that differs from what was asked."""

    tick: q.Tick
    stamp_ns: q.Nanoseconds
    sequence: q.Tick | None  # None: no controller's command, the host's own safe action
    mode: Annotated[list[Mode], Meta(max_length=q.MAX_JOINTS)]
    target: q.Targets
    torque_limit_nm: q.TorqueLimits
    limited: Annotated[dict[q.Name, q.Reason], Meta(max_length=q.MAX_JOINTS)] = {}


# --- the HAL itself --------------------------------------------------------------------------------------------


class Clock(Message, frozen=True, kw_only=True):
    """`hal/clock`: the only time that GNC knows, and the table of contents of everything published so far.

    `newest` maps a sensor key, or the name of a service, to the tick of the newest sample that counts now. The clock is
    published last, so a reader that takes what `newest` names reads the same data in every lockstep run.
    """

    tick: q.Tick
    stamp_ns: q.Nanoseconds
    period_ns: q.Nanoseconds
    pace: Pace
    lifecycle: LifecycleState
    arming: q.Tick  # how often the robot has been armed; a new value tells a controller to start afresh
    lease_epoch: q.Tick  # of the live lease; 0 when nobody holds one
    newest: Annotated[dict[q.Name, q.Tick], Meta(max_length=64)]


class JointDescription(Message, frozen=True, kw_only=True):
    """One joint: its name, its place in every vector, and what it can do."""

    name: q.Name
    axis: Axis
    angle_min_rad: q.Angle
    angle_max_rad: q.Angle
    speed_limit_rad_s: q.AngularVelocity
    acceleration_limit_rad_s2: Annotated[float, Meta(gt=0, le=1e6)]
    torque_limit_nm: q.Torque
    torque_rate_limit_nm_s: Annotated[float, Meta(gt=0, le=1e6)]
    stiffness_nm_per_rad: Annotated[float, Meta(ge=0, le=1e6)]  # of position mode
    damping_nm_s_per_rad: Annotated[float, Meta(ge=0, le=1e6)]
    velocity_gain_nm_s_per_rad: Annotated[float, Meta(gt=0, le=1e6)]  # of velocity mode
    derate_from_c: q.Temperature = 80.0  # of the winding: from here on torque is taken away
    stop_at_c: q.Temperature = 105.0  # there the robot is stopped
    least_voltage_v: q.Voltage = 18.0  # below it, too


class LinkDescription(Message, frozen=True, kw_only=True):
    """One rigid link, tail to head: a capsule along its own x axis."""

    name: q.Name
    length_m: q.Length
    radius_m: q.Length
    mass_kg: Annotated[float, Meta(gt=0, le=1e4)]


class SensorDescription(Message, frozen=True, kw_only=True):
    """What a sensor delivers, and how often; of IMUs it is the rate of each link, which need not come together."""

    key: q.Name
    rate_hz: Annotated[float, Meta(gt=0, le=1e5)]
    delay_s: Annotated[float, Meta(ge=0, le=10)]


class Description(Message, frozen=True, kw_only=True):
    """`hal/description`, latched: the robot as the backend has it. The order of joints is defined here only."""

    robot: q.Name
    backend: q.Name
    layout: q.Name  # hash of the joints' names, order and axes; every command carries it
    config_hash: q.Name
    period_ns: q.Nanoseconds
    lease_ns: q.Nanoseconds
    max_step_rad: Annotated[float, Meta(gt=0, le=10)]  # a position target further from the measured is limited
    safe_action: SafeAction
    may_lose_joints: Annotated[int, Meta(ge=0, le=q.MAX_JOINTS)] = 0  # that fail, before the robot stops
    emulated: bool = False  # nothing real moves: a simulator, or emulated modules; faults on request are allowed
    joints: Annotated[list[JointDescription], Meta(min_length=1, max_length=q.MAX_JOINTS)]
    links: Annotated[list[LinkDescription], Meta(min_length=2, max_length=q.MAX_JOINTS + 1)]
    sensors: Annotated[list[SensorDescription], Meta(max_length=32)]


class Fault(Message, frozen=True, kw_only=True):
    """One thing that went wrong, and where.

    reach says how far it goes. A backend says "joint" of what leaves the other joints as they were, so that the robot
    may go on without this one if its file says so; what stopped the robot is told with "robot".
    """

    tick: q.Tick
    what: q.Name  # a short word to count by: lease_expired, service_lost, diverged, ...
    cause: q.Reason
    joint: q.Name | None = None
    reach: Reach = "robot"


class Status(Message, frozen=True, kw_only=True):
    """`hal/status`, latched: how the robot is, and why."""

    tick: q.Tick
    stamp_ns: q.Nanoseconds
    robot: q.Name
    backend: q.Name
    pace: Pace
    rate_hz: Annotated[float, Meta(gt=0, le=1e5)]
    lifecycle: LifecycleState
    why: q.Reason
    lease_holder: q.Name | None
    lease_epoch: q.Tick
    commands_accepted: q.Tick
    commands_standby: q.Tick  # good commands while disarmed: heard, not enacted
    commands_rejected: Annotated[dict[q.Name, q.Tick], Meta(max_length=64)]
    commands_limited: Annotated[dict[q.Name, q.Tick], Meta(max_length=64)]
    faults: Annotated[list[Fault], Meta(max_length=64)]
    alive: Annotated[list[q.Name], Meta(max_length=64)]
    waiting_for: Annotated[list[q.Name], Meta(max_length=64)]
    overruns: q.Tick
    ready_to_arm: bool
    injected: Annotated[list[q.Reason], Meta(max_length=64)] = []  # faults on request that are on now
    hygiene: Annotated[list[q.Reason], Meta(max_length=16)] = []  # real-time measures that the system refused
    derated: Annotated[dict[q.Name, q.Fraction], Meta(max_length=q.MAX_JOINTS)] = {}  # joint -> torque it has left
    isolated: Annotated[list[q.Name], Meta(max_length=q.MAX_JOINTS)] = []  # joints that failed, and are passive


class LeaseRequest(Message, frozen=True, kw_only=True):
    """Query payload on `hal/lease`."""

    action: Literal["acquire", "renew", "release"]
    holder: q.Name
    epoch: q.Tick = 0
    priority: Annotated[int, Meta(ge=0, le=255)] = 100


class LifecycleRequest(Message, frozen=True, kw_only=True):
    """Query payload on `hal/lifecycle`. Arming names robot and backend, so that the two cannot be mixed up."""

    action: Literal["arm", "disarm", "clear", "finish"]
    robot: q.Name | None = None
    backend: q.Name | None = None
    config_hash: q.Name | None = None  # of the description that whoever arms has read


class EstopRequest(Message, frozen=True, kw_only=True):
    """Query payload on `hal/estop`; needs no lease. Latched until `clear` on `hal/lifecycle`."""

    who: q.Name


class FaultRequest(Message, frozen=True, kw_only=True):
    """Query payload on `fault/<part>`: let something go wrong now, or end it. Only runs that allow faults do it."""

    kind: q.Name
    target: q.Name
    for_s: Annotated[float, Meta(gt=0, le=86400)] | None = None  # None: until it is ended
    amount: q.Scalar | None = None
    end: bool = False


class Answer(Message, frozen=True, kw_only=True):
    """Reply to every query: whether it was done, and if not, why not, for people and in one stable word.

    lease       lease_held (by someone of no lower priority), not_holder (of that epoch)
    lifecycle   not_ready (a condition for arming is not met), wrong_state, wrong_robot, wrong_backend, wrong_config
    any key     malformed, unknown_version and the like: what was asked could not be read; the decoder's own words
    """

    ok: bool
    reason: q.Reason
    refusal: q.Name | None = None  # a short word to decide by: lease_held, not_ready, wrong_state, not_allowed, ...
    epoch: q.Tick = 0
    lifecycle: LifecycleState = "disarmed"


class Done(Message, frozen=True, kw_only=True):
    """`hal/done/<service>`: a lockstep participant has published all that it owes for a tick."""

    tick: q.Tick


# --- guidance, navigation, control -----------------------------------------------------------------------------


class Obstacle(Message, frozen=True, kw_only=True):
    """Something known to stand in the world: an upright shape with its outline."""

    name: q.Name
    shape: Literal["cylinder", "box", "sphere"]
    position_w: q.Vector  # centre of the shape
    yaw_rad: q.Angle = 0.0
    radius_m: q.Length = 0.0  # cylinder, sphere
    half_size_m: q.Vector = (0.0, 0.0, 0.0)  # box
    height_m: q.Length = 0.0
    confidence: q.Fraction = 1.0


class WorldContact(Message, frozen=True, kw_only=True):
    """A contact in the world frame, and where along the body it is."""

    link: q.LinkIndex
    obstacle: q.Name | None
    body_s_m: q.Length  # arc length from the tail end along the chain
    position_w: q.Vector
    normal_w: q.UnitVector
    tangent_w: q.UnitVector
    force_w: q.ForceVector
    confidence: q.Fraction = 1.0


class World(Message, frozen=True, kw_only=True):
    """`guidance/world`: where the body is, what it touches, what stands near it."""

    tick: q.Tick
    stamp_ns: q.Nanoseconds
    base_position_w: q.Vector
    base_orientation_wxyz: q.Quaternion
    base_confidence: q.Fraction
    contacts: Annotated[list[WorldContact], Meta(max_length=q.MAX_CONTACTS)]
    obstacles: Annotated[list[Obstacle], Meta(max_length=4096)]


class Trajectory(Message, frozen=True, kw_only=True):
    """`navigation/trajectory`: the path to take, how fast, and the push-points expected along it."""

    tick: q.Tick
    stamp_ns: q.Nanoseconds
    path_id: q.Tick  # changes when `path_w` does
    path_w: Annotated[list[tuple[q.Length, q.Length]], Meta(min_length=2, max_length=20000)]
    speed_m_s: q.Velocity
    push_points: Annotated[list[q.Name], Meta(max_length=512)]  # obstacles within reach of the path, in order
    finished: bool


class ControlState(Message, frozen=True, kw_only=True):
    """`control/state`: what the controller thinks it is doing, and why. Telemetry; nothing depends on it."""

    tick: q.Tick
    stamp_ns: q.Nanoseconds
    controller: q.Name
    state: LocomotionState
    reason: q.Reason
    path_s_m: q.Length | None = None  # arc length of the tail along the path
    propulsion_joint: q.Name | None = None
    propulsion_n: q.Force | None = None
    push_points: Annotated[list[WorldContact], Meta(max_length=64)] = []
    solved_force_n: Annotated[list[q.Force], Meta(max_length=64)] = []
    propulsion_torque_nm: q.Torque | None = None
    bending_torque_nm: q.Torques = []
    reference_rad: q.Angles = []
    condition: q.Scalar | None = None
    torque_headroom_nm: q.Torque | None = None
    saturated: bool = False
    jammed: bool = False


class Intent(Message, frozen=True, kw_only=True):
    """`operator/intent`: what a person or a mission wants."""

    stamp_ns: q.Nanoseconds
    who: q.Name
    speed_m_s: q.Velocity | None = None
    go: bool = True


VERSIONS: dict[type[Message], int] = dict.fromkeys(
    (
        JointState,
        Contacts,
        Imu,
        Pose,
        Power,
        JointCommand,
        AppliedCommand,
        Clock,
        Description,
        Status,
        LeaseRequest,
        LifecycleRequest,
        EstopRequest,
        FaultRequest,
        Answer,
        Done,
        World,
        Trajectory,
        ControlState,
        Intent,
    ),
    1,
)
"""Every message that may stand alone on the wire, with its version."""
