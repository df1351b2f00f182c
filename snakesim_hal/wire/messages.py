"""The wire contract: every message that crosses Zenoh, as a frozen Struct with bounds.

Vectors run over all joints, tail to head, in the order of the description. Frames are name suffixes: `_w` world,
`_l` the link's own frame (x forward along the link, origin at its rear joint). Quaternions are wxyz.
A new field gets a default; a change of meaning gets a new version in `VERSIONS`.

The meaning of a field is its `about`, because the published schemas are generated from this file.
"""

from enum import IntEnum
from typing import Annotated, Literal, get_args

import msgspec
from msgspec import Meta

from snakesim_hal.wire import quantities as q
from snakesim_hal.wire.quantities import about

ClockMode = Literal["realtime", "lockstep", "free"]
LifecycleState = Literal["disarmed", "armed", "fault", "estop"]
LocomotionState = Literal["PowerOff", "Idle", "NotLocomoting", "Locomoting"]
StopMode = Literal["passive", "damp", "hold"]
Reach = Literal["robot", "joint", "none"]
Axis = Literal["yaw", "pitch"]
Measurement = Literal["torque", "temperature", "voltage"]

A_JOINT = "one entry a joint"
MAX_CONFIG = 500_000  # characters
RANGE_SLACK_FRACTION = 0.05  # of the stated range of a camera or lidar: room for noise at its ends
PACE = about("realtime: by the wall clock; lockstep: each tick waits for all services; free: without waiting")
LIFECYCLE = about("motors follow commands only in armed; fault and estop stay until a reset")
HOST = about("random id of the host process, new at each start; null: unknown")


class Mode(IntEnum):
    """How a joint uses its target.

    0 passive: motor off, the target is ignored
    1 position: target in rad
    2 velocity: target in rad/s
    3 torque: target in N·m
    """

    PASSIVE = 0
    POSITION = 1
    VELOCITY = 2
    TORQUE = 3


Modes = Annotated[list[Mode], Meta(max_length=q.MAX_JOINTS), about(A_JOINT)]


class Message(msgspec.Struct, frozen=True):
    """Base of everything on the wire. Unknown fields are ignored, so that fields can be added."""


# --- sensors ---------------------------------------------------------------------------------------------------


class JointState(Message, frozen=True, kw_only=True):
    """`sensor/joints`: every joint at one instant."""

    tick: q.Tick
    timestamp_ns: q.Stamp
    angle_rad: Annotated[q.Angles, about("positive: yaw to the left, pitch downwards, seen towards the head")]
    velocity_rad_s: Annotated[q.AngularVelocities, about(A_JOINT)]
    torque_nm: Annotated[
        q.Torques,
        about("of the motor; positive turns towards positive angles; 0 of a joint that does not measure it"),
    ]
    valid: Annotated[q.Flags, about("false: its numbers are outdated, and must not be used")]
    age_ns: Annotated[q.Ages, about("how long before `timestamp_ns` each joint was measured")]

    def has_joint_count(self, joints: int) -> bool:
        """Return whether every list has an entry for each of so many joints."""
        return (
            len(self.angle_rad) == joints
            and len(self.velocity_rad_s) == joints
            and len(self.torque_nm) == joints
            and len(self.valid) == joints
            and len(self.age_ns) == joints
        )


class Contact(Message, frozen=True, kw_only=True):
    """One contact of a link with an obstacle (not the ground); all vectors in the link's frame."""

    link: Annotated[q.LinkIndex, about("number of the link, from 0 at the tail")]
    obstacle: Annotated[q.Name | None, about("touched obstacle; null: the sensor cannot tell")]
    position_l: q.Vector
    normal_l: Annotated[q.UnitVector, about("from the obstacle into the body")]
    tangent_1_l: Annotated[q.UnitVector, about("across the normal, towards the head")]
    tangent_2_l: Annotated[q.UnitVector, about("across both")]
    force_l: Annotated[q.ForceVector, about("on the body")]
    torque_l: Annotated[q.TorqueVector, about("on the body about the contact point")]


class Contacts(Message, frozen=True, kw_only=True):
    """`sensor/contacts`: all contacts at one instant; an empty list means no contact."""

    tick: q.Tick
    timestamp_ns: q.Stamp
    contacts: Annotated[list[Contact], Meta(max_length=q.MAX_CONTACTS)]
    measured_force_n: Annotated[
        q.Force | None,
        about(
            "largest force of one obstacle on one link, as a mean over the last 50 ms; null: the sensor does not tell"
        ),
    ] = None


class Imu(Message, frozen=True, kw_only=True):
    """`sensor/imu`: one entry a link that carries an IMU, at its middle, in the link's frame."""

    tick: q.Tick
    timestamp_ns: q.Stamp
    link: Annotated[list[q.LinkIndex], Meta(max_length=q.MAX_JOINTS + 1), about("their numbers, from 0 at the tail")]
    angular_velocity_rad_s: Annotated[list[q.AngularVelocityVector], Meta(max_length=q.MAX_JOINTS + 1)]
    acceleration_m_s2: Annotated[
        list[q.AccelerationVector], Meta(max_length=q.MAX_JOINTS + 1), about("specific force: at rest 1 g upwards")
    ]


class Pose(Message, frozen=True, kw_only=True):
    """`sensor/pose`: pose of the base (tail end of link 0) from motion capture."""

    tick: q.Tick
    timestamp_ns: q.Stamp
    position_w: q.Vector
    orientation_wxyz: q.Quaternion
    velocity_w: q.VelocityVector
    angular_velocity_w: q.AngularVelocityVector


class Power(Message, frozen=True, kw_only=True):
    """`sensor/power`: supply and health of the joint modules, one entry a joint."""

    tick: q.Tick
    timestamp_ns: q.Stamp
    voltage_v: Annotated[list[q.Voltage], Meta(max_length=q.MAX_JOINTS)]
    current_a: Annotated[list[q.Current], Meta(max_length=q.MAX_JOINTS)]
    motor_c: Annotated[list[q.Temperature], Meta(max_length=q.MAX_JOINTS), about("of the winding")]
    board_c: Annotated[list[q.Temperature], Meta(max_length=q.MAX_JOINTS), about("of the electronics")]
    leak: Annotated[q.Flags, about("true: water inside")]
    valid: Annotated[q.Flags, about("false: the state of this module is unknown")]


class MountedSample(Message, frozen=True, kw_only=True):
    """Base of the samples of sensors that are mounted on a link."""

    tick: q.Tick
    timestamp_ns: Annotated[q.Stamp, about("of the measurement; `tick` is later by the delay")]
    link: Annotated[q.LinkIndex, about("that carries the sensor, from 0 at the tail")]
    position_l: Annotated[q.Vector, about("of the sensor")]
    orientation_l_wxyz: Annotated[q.Quaternion, about("of the sensor's frame in that of the link")]

    def find_contradiction(self) -> str:
        """Describe what is impossible although each number is within its bounds; empty if nothing is.

        The contract suite of backends calls it.
        """
        return ""


class CameraImage(MountedSample, frozen=True, kw_only=True):
    """Base of the images of a pinhole camera. DepthImage describes its frame."""

    width: Annotated[int, Meta(ge=1, le=q.MAX_IMAGE_WIDTH), about("pixels in a row")]
    height: Annotated[int, Meta(ge=1, le=q.MAX_IMAGE_HEIGHT), about("rows")]
    fx_px: q.FocalLength
    fy_px: q.FocalLength
    cx_px: q.Pixels
    cy_px: q.Pixels


class DepthImage(CameraImage, frozen=True, kw_only=True):
    """`sensor/depth/<name>`: distances to the surfaces that a camera sees.

    Camera frame: x forward along the optical axis, y to the left, z upwards. The ray through pixel (u, v), u to the
    right and v downwards from the middle of the top left one, is (1, -(u - cx_px) / fx_px, -(v - cy_px) / fy_px).
    """

    range_min_m: Annotated[q.Distance, about("along the optical axis; what is nearer is 0 in `depth`")]
    range_max_m: Annotated[q.Distance, about("along the optical axis; what is further is 0 in `depth`")]
    scale_m: Annotated[float, Meta(gt=0, le=1), about("meters per count of `depth`")]
    depth: Annotated[
        bytes,
        Meta(max_length=2 * q.MAX_PIXELS),
        about(
            "uint16, little endian, row by row from the top: distance along the optical axis in counts; "
            "0: nothing within range, or the pixel dropped out"
        ),
    ]

    def find_contradiction(self) -> str:
        whole_pixels = self.depth[: len(self.depth) // 2 * 2]
        counts = set(memoryview(whole_pixels).cast("H")) - {0}
        distances_m = [count * self.scale_m for count in counts]
        return _describe_beyond_range(self.range_min_m, self.range_max_m, distances_m)


class ColorImage(CameraImage, frozen=True, kw_only=True):
    """`sensor/color/<name>`: what a camera sees, in color. Frame and pixels are as in DepthImage."""

    rgb: Annotated[
        bytes, Meta(max_length=3 * q.MAX_PIXELS), about("red, green and blue of each pixel, row by row from the top")
    ]


class Ranges(MountedSample, frozen=True, kw_only=True):
    """`sensor/range/<name>`: distances along the beams of a 2-D lidar, or along the one of a range finder.

    Beams lie in the xy plane of the sensor's frame; beam i is turned by `angle_min_rad` + i x `angle_step_rad` from x,
    positive to the left.
    """

    angle_min_rad: Annotated[q.Angle, about("of the first beam")]
    angle_step_rad: Annotated[q.Angle, about("from one beam to the next")]
    range_min_m: Annotated[q.Distance, about("along the beam; what is nearer is null")]
    range_max_m: Annotated[q.Distance, about("along the beam; what is further is null")]
    range_m: Annotated[
        list[q.Distance | None],
        Meta(min_length=1, max_length=q.MAX_BEAMS),
        about("one entry a beam; null: nothing within range, or the beam dropped out"),
    ]

    def find_contradiction(self) -> str:
        distances_m = [distance_m for distance_m in self.range_m if distance_m is not None]
        return _describe_beyond_range(self.range_min_m, self.range_max_m, distances_m)


def _describe_beyond_range(min_m: float, max_m: float, distances_m: list[float]) -> str:
    """Describe distances that are beyond the range of their sensor; empty if all are within it."""
    slack_m = RANGE_SLACK_FRACTION * max_m
    if min_m < max_m and all(min_m - slack_m <= distance_m <= max_m + slack_m for distance_m in distances_m):
        return ""
    measured = "nothing"
    if distances_m:
        measured = f"{min(distances_m)} to {max(distances_m)} m"
    return f"{measured} was measured, and its range is {min_m} to {max_m} m"


class CustomSample(MountedSample, frozen=True, kw_only=True):
    """`sensor/custom/<name>`: of a custom sensor, whose message has further fields: those in `Description.custom`."""


class Preview(Message, frozen=True, kw_only=True):
    """`preview/depth/<camera>` or `preview/color/<camera>`: a small, compressed copy of an image."""

    tick: q.Tick
    timestamp_ns: Annotated[q.Stamp, about("of the image that it was made from")]
    width: Annotated[int, Meta(ge=1, le=q.MAX_IMAGE_WIDTH), about("pixels in a row of this copy")]
    height: Annotated[int, Meta(ge=1, le=q.MAX_IMAGE_HEIGHT), about("rows of this copy")]
    format: Annotated[Literal["jpeg", "png"], about("of `data`: jpeg in color, png of 16 bits for depth")]
    scale_m: Annotated[
        Annotated[float, Meta(gt=0, le=1)] | None,
        about("meters per count of depth, which is 0 for nothing within range; null: it is in color"),
    ] = None
    data: Annotated[bytes, Meta(max_length=q.MAX_PREVIEW_BYTES), about("the file")]


# --- actuators -------------------------------------------------------------------------------------------------


class JointCommand(Message, frozen=True, kw_only=True):
    """`actuator/joints`: setpoints for every joint from the lease holder. The checks are in protocol.md."""

    tick: Annotated[q.Tick, about("of the joint state that the command answers: its age is the command's age")]
    sequence: Annotated[q.Count, about("greater than that of any command accepted under this lease; gaps are allowed")]
    lease_epoch: Annotated[q.Count, about("`Answer.epoch` of the lease")]
    layout: Annotated[q.Name, about("`Description.layout`")]
    valid_for_ns: Annotated[
        q.Nanoseconds,
        about("rejected as stale this long after the state was published; at most a lease term"),
    ]
    mode: Modes
    target: q.Targets
    torque_limit_nm: Annotated[
        q.TorqueLimits | None, about("limit of each motor, if lower than the robot's own; null: the robot's own")
    ] = None
    arm_session: Annotated[
        q.Count,
        about("`Clock.arm_session`; 0: before any arming. An armed robot rejects any number but its own, including 0"),
    ] = 0


class AppliedCommand(Message, frozen=True, kw_only=True):
    """`hal/applied`: the setpoints that the motors got in a tick, and where they differ from the command."""

    tick: q.Tick
    timestamp_ns: q.Stamp
    sequence: Annotated[q.Count | None, about("of the command; null: the host's own stop mode")]
    mode: Modes
    target: q.Targets
    torque_limit_nm: q.TorqueLimits
    limited: Annotated[
        dict[q.Name, q.Reason],
        Meta(max_length=q.MAX_JOINTS),
        about(
            "joint -> which limit changed its target: angle, angle_rate, speed, acceleration, torque, torque_rate, "
            "thermal, isolated"
        ),
    ] = {}


# --- the HAL itself --------------------------------------------------------------------------------------------


class Clock(Message, frozen=True, kw_only=True):
    """`hal/clock`: the only clock of GNC, and an index of everything published so far.

    It is published last, so a reader that uses the samples named by `newest` reads the same data in every lockstep run.
    """

    tick: q.Tick
    timestamp_ns: Annotated[q.Stamp, about("robot time: `tick` x `period_ns`")]
    period_ns: q.Nanoseconds
    clock_mode: Annotated[ClockMode, PACE]
    lifecycle: Annotated[LifecycleState, LIFECYCLE]
    arm_session: Annotated[
        q.Count, about("how often the robot has been armed since its host started; a new number: reset the controller")
    ]
    lease_epoch: Annotated[q.Count, about("of the live lease; 0: there is none")]
    newest: Annotated[
        dict[q.Name, q.Tick],
        Meta(max_length=64),
        about("sensor key or service -> tick of its newest sample that is valid now"),
    ]
    paused: Annotated[
        bool, about("true: not a new tick; the last clock is repeated as a sign of life while robot time is paused")
    ] = False


class JointDescription(Message, frozen=True, kw_only=True):
    """One joint: its name, its position in every vector, and its limits."""

    name: q.Name
    axis: Annotated[Axis, about("of its rear link about which the joint turns: yaw about z, pitch about y")]
    angle_min_rad: q.Angle
    angle_max_rad: q.Angle
    speed_limit_rad_s: q.AngularVelocity
    acceleration_limit_rad_s2: Annotated[float, Meta(gt=0, le=1e6)]
    torque_limit_nm: q.Torque
    torque_rate_limit_nm_s: Annotated[float, Meta(gt=0, le=1e6)]
    stiffness_nm_per_rad: Annotated[float, Meta(ge=0, le=1e6), about("of position mode")]
    damping_nm_s_per_rad: Annotated[float, Meta(ge=0, le=1e6), about("of position mode")]
    velocity_gain_nm_s_per_rad: Annotated[float, Meta(gt=0, le=1e6), about("of velocity mode")]
    rotor_kg_m2: Annotated[
        float,
        q.from_zero(1e3, "kg·m²"),
        about("inertia that `torque_nm` turns besides the links; 0: measured beyond the rotor"),
    ] = 0.0
    derate_from_c: Annotated[q.Temperature, about("of the winding: above it torque is derated")] = 80.0
    stop_at_c: Annotated[q.Temperature, about("of the winding: at it the robot is stopped")] = 105.0
    min_voltage_v: Annotated[q.Voltage, about("below it the robot is stopped")] = 18.0
    modes: Annotated[
        list[Mode], Meta(min_length=1, max_length=4), about("in which it may be commanded; passive it always can be")
    ] = msgspec.field(default_factory=lambda: list(Mode))
    measures: Annotated[
        list[Measurement],
        Meta(max_length=8),
        about("beside angle and velocity; a torque that is not measured is 0, heat and voltage then stop nothing"),
    ] = msgspec.field(default_factory=lambda: list(get_args(Measurement)))
    serial: Annotated[str, Meta(max_length=64), about("serial number that its drive reports; empty: none")] = ""
    firmware: Annotated[str, Meta(max_length=64), about("firmware version that its drive reports; empty: none")] = ""

    def supports_mode(self, mode: Mode) -> bool:
        """Return whether the joint may be commanded in a mode. It can always be passive."""
        return mode is Mode.PASSIVE or mode in self.modes


class LinkDescription(Message, frozen=True, kw_only=True):
    """One rigid link, tail to head: a capsule along its own x axis."""

    name: q.Name
    length_m: q.Length
    radius_m: q.Length
    mass_kg: Annotated[float, Meta(gt=0, le=1e4)]


class SensorDescription(Message, frozen=True, kw_only=True):
    """A sensor and its rate; for IMUs the rate of each link, which need not be sampled together."""

    key: Annotated[q.Name, about("where it is published, such as sensor/pose; only listed keys are published")]
    rate_hz: Annotated[float, Meta(gt=0, le=1e5)]
    delay_s: Annotated[float, Meta(ge=0, le=10)]


class Description(Message, frozen=True, kw_only=True):
    """`hal/description`, latched: the robot, as described by its backend. Only this defines the order of joints."""

    robot: q.Name
    backend: Annotated[q.Name, about("name of the backend: sim, can, ...")]
    layout: Annotated[q.Name, about("hash of the joints' names, order and axes; every command carries it")]
    config_hash: Annotated[q.Name, about("of the whole configuration; a request to arm carries it")]
    period_ns: Annotated[q.Nanoseconds, about("from tick to tick")]
    lease_ns: Annotated[q.Nanoseconds, about("a lease term: how long one accepted command keeps the robot armed")]
    max_step_rad: Annotated[float, Meta(gt=0, le=10), about("a position target further from the measured is limited")]
    stop_mode: Annotated[StopMode, about("in fault: passive, brake (damp), or decelerate and then hold")]
    max_isolated_joints: Annotated[
        int, Meta(ge=0, le=q.MAX_JOINTS), about("how many may fail while armed before the robot stops")
    ] = 0
    emulated: Annotated[
        bool, about("nothing real moves: a simulator, or emulated modules; fault injection is allowed")
    ] = False
    simulated_time: Annotated[
        bool, about("a simulator: its time can stand, pass by single ticks, faster or slower, and start over")
    ] = False
    hardware: Annotated[
        str, Meta(max_length=200), about("hardware that it drives, such as `can0+can1`; empty: none")
    ] = ""
    host: Annotated[q.Name | None, HOST] = None
    proof: Annotated[str, Meta(max_length=64), about("for the run that started the host; of no use to others")] = ""
    arithmetic: Annotated[
        dict[q.Name, q.Name],
        Meta(max_length=8),
        about("hashes of what the host's BLAS, NumPy and C library compute: where they are equal, digests can be"),
    ] = {}
    laws: Annotated[
        Literal["c", "python"] | None,
        about("in which language a simulator computes ground and friction, with equal results; null: no simulator"),
    ] = None
    joints: Annotated[list[JointDescription], Meta(min_length=1, max_length=q.MAX_JOINTS), about("tail to head")]
    links: Annotated[
        list[LinkDescription],
        Meta(min_length=2, max_length=q.MAX_JOINTS + 1),
        about("tail to head: joint i, from 0, connects link i and link i + 1"),
    ]
    sensors: Annotated[list[SensorDescription], Meta(max_length=48)]
    custom: Annotated[
        dict[q.Name, Annotated[str, Meta(max_length=q.MAX_CUSTOM_SCHEMA)]],
        Meta(max_length=q.MAX_CUSTOM_SENSORS),
        about("key -> JSON Schema of its message, of each sensor with a custom message, from any process"),
    ] = {}


class Configuration(Message, frozen=True, kw_only=True):
    """`hal/config`, latched: the effective configuration of the run, which explains a recording."""

    config_hash: Annotated[q.Name, about("as in the description")]
    content: Annotated[str, Meta(max_length=MAX_CONFIG), about("JSON, as `schemas/files/run.json` describes it")]


class Fault(Message, frozen=True, kw_only=True):
    """One fault, and its location."""

    tick: q.Tick
    what: Annotated[q.Name, about("a short word to count by: lease_expired, service_lost, diverged, ...")]
    cause: q.Reason
    joint: Annotated[q.Name | None, about("null: it is not about one joint")] = None
    reach: Annotated[
        Reach,
        about(
            "joint: the others are not affected, and the robot may go on if its file allows it; none: it stops nothing"
        ),
    ] = "robot"


class Timing(Message, frozen=True, kw_only=True):
    """How long something took, many times: percentiles to 5 %, and a histogram on a logarithmic scale."""

    count: Annotated[q.Count, about("how many were measured")]
    median_us: q.Microseconds
    p99_us: Annotated[q.Microseconds, about("99 % took no longer")]
    max_us: q.Microseconds
    low_us: Annotated[q.Microseconds, about("where the first bin begins; it counts all that is below, too")]
    bin_decades: Annotated[float, q.from_zero(8.0, "1"), about("width of a bin: log10 of its end over its begin")]
    bins: Annotated[list[q.Count], Meta(max_length=64)]


TICK_TIMES = {  # of `Status.tick_times`
    "cycle": "from tick to tick",
    "late": "begin of a tick after its deadline",
    "read": "the backend reads its sensors",
    "write": "the backend takes setpoints",
}


class Status(Message, frozen=True, kw_only=True):
    """`hal/status`, latched: the state of the robot, and its reason."""

    tick: q.Tick
    timestamp_ns: q.Stamp
    robot: q.Name
    backend: q.Name
    clock_mode: Annotated[ClockMode, PACE]
    rate_hz: Annotated[float, Meta(gt=0, le=1e5)]
    lifecycle: Annotated[LifecycleState, LIFECYCLE]
    reason: Annotated[q.Reason, about("why it is in this state, and while disarmed what prevents arming")]
    lease_holder: Annotated[q.Name | None, about("null: the lease is free")]
    lease_epoch: Annotated[q.Count, about("of the lease, or of the last one when it is free")]
    commands_accepted: Annotated[q.Count, about("while armed")]
    commands_standby: Annotated[q.Count, about("valid commands while disarmed: received, not enacted")]
    commands_rejected: Annotated[dict[q.Name, q.Count], Meta(max_length=64), about("how many, by reason")]
    commands_limited: Annotated[dict[q.Name, q.Count], Meta(max_length=64), about("how many targets, by limit")]
    faults: Annotated[list[Fault], Meta(max_length=64), about("since the last reset; not all of them stop the robot")]
    alive: Annotated[list[q.Name], Meta(max_length=64), about("services of the run with a liveliness token")]
    waiting_for: Annotated[list[q.Name], Meta(max_length=64), about("services that arming waits for")]
    overruns: Annotated[q.Count, about("ticks that were late, while armed in real time")]
    ready_to_arm: Annotated[bool, about("whether a request to arm that names the right robot would be granted now")]
    injected: Annotated[list[q.Reason], Meta(max_length=64), about("injected faults that are active now")] = []
    realtime_warnings: Annotated[
        list[q.Reason], Meta(max_length=16), about("real-time measures that the system refused")
    ] = []
    derated: Annotated[
        dict[q.Name, q.Fraction], Meta(max_length=q.MAX_JOINTS), about("joint -> share of its torque left by derating")
    ] = {}
    isolated: Annotated[
        list[q.Name], Meta(max_length=q.MAX_JOINTS), about("joints that failed, and are passive until a reset")
    ] = []
    host: Annotated[q.Name | None, HOST] = None
    faults_left_out: Annotated[q.Count, about("of `faults`, between the first and the newest")] = 0
    paused_by: Annotated[q.Name | None, about("who paused the simulator; null: it is not paused")] = None
    speed: Annotated[q.Speed, about("wanted in real time: robot time per wall time")] = 1.0
    real_time_factor: Annotated[
        Annotated[float, q.from_zero(1e6, "1")] | None,
        about("robot time per wall time over the last second; null: not measured, such as in a pause"),
    ] = None
    tick_times: Annotated[
        dict[q.Name, Timing],
        Meta(max_length=8),
        about(
            "while armed. cycle: from the begin of a tick to the next one's; late: begin of a tick after its deadline, "
            "in real time; read, write: the backend's calls"
        ),
    ] = {}
    unchecked: Annotated[
        q.Reason,
        about("why arming needs the word `unchecked`: its joints were not checked as they are now; empty: it does not"),
    ] = ""
    held_up: Annotated[
        q.Reason, about("which answer to which tick lockstep has been waiting for, if longer than half a second")
    ] = ""


class LeaseRequest(Message, frozen=True, kw_only=True):
    """Query payload on `hal/lease`: the right to command, for a term. Accepted commands renew it."""

    action: Annotated[
        Literal["acquire", "renew", "release"],
        about("renew works only while disarmed: an armed robot needs commands"),
    ]
    holder: Annotated[q.Name, about("name of the requester; a service of the run uses its own name")]
    epoch: Annotated[q.Count, about("of the lease that is renewed or released; acquire needs none")] = 0
    priority: Annotated[
        int,
        Meta(ge=0, le=255),
        about("a live lease is taken over only by a greater one, which disarms an armed robot"),
    ] = 100


class LifecycleRequest(Message, frozen=True, kw_only=True):
    """Query payload on `hal/lifecycle`. Arming names robot and backend, so that the wrong one is not armed."""

    action: Annotated[
        Literal["arm", "disarm", "reset", "finish"],
        about("reset leads from fault or estop to disarmed; finish disarms, and ends the run"),
    ]
    requester: Annotated[q.Name, about("name of the requester, for status, log and summary")] = "an unnamed client"
    host: Annotated[q.Name | None, about("id of the addressed host process; null: any")] = None
    robot: Annotated[q.Name | None, about("`Description.robot`; arm needs it, others may leave it null")] = None
    backend: Annotated[q.Name | None, about("`Description.backend`; arm needs it, others may leave it null")] = None
    config_hash: Annotated[
        q.Name | None, about("`Description.config_hash`; arm needs it, others may leave it null")
    ] = None
    unchecked: Annotated[
        bool, about("arm also if `Status.unchecked` gives a reason why the joints do not count as checked")
    ] = False


def make_arm_request(robot: Description, requester: str, *, unchecked: bool = False) -> LifecycleRequest:
    """Make a request to arm exactly the robot, backend, configuration and host process that are described.

    Args:
        robot: the description that the host publishes.
        requester: name of the requester, for status, log and summary.
        unchecked: arm also a robot whose joints were not checked as they are now.
    """
    return LifecycleRequest(
        action="arm",
        requester=requester,
        host=robot.host,
        robot=robot.robot,
        backend=robot.backend,
        config_hash=robot.config_hash,
        unchecked=unchecked,
    )


class EstopRequest(Message, frozen=True, kw_only=True):
    """Query payload on `hal/estop`; needs no lease. Latched until `reset` on `hal/lifecycle`."""

    requester: Annotated[q.Name, about("name of the requester, for status, log and summary")]


class SimulatorRequest(Message, frozen=True, kw_only=True):
    """Query payload on `hal/simulator`: its time. Only for a robot with `Description.simulated_time`."""

    action: Annotated[
        Literal["pause", "resume", "step", "speed", "reset"],
        about("step: some ticks, then paused; reset: another host, at the start and disarmed, takes the place of this"),
    ]
    requester: Annotated[q.Name, about("name of the requester, for status, log and summary")] = "an unnamed client"
    host: Annotated[q.Name | None, about("id of the addressed host process; null: any")] = None
    ticks: Annotated[int, Meta(ge=1, le=1_000_000), about("of a step")] = 1
    speed: Annotated[q.Speed, about("robot time per wall time, in real time; 1: as the wall")] = 1.0


class FaultRequest(Message, frozen=True, kw_only=True):
    """Query payload on `fault/<part>`: inject a fault now, or end it. Only in runs that allow it."""

    kind: Annotated[q.Name, about("kind of fault: `snakesim fault list` prints all")]
    target: Annotated[q.Name, about("a process, key, joint or bus, such as joint_3")]
    for_s: Annotated[
        Annotated[float, Meta(gt=0, le=86400)] | None, about("seconds of robot time; null: until it is ended")
    ] = None
    amount: Annotated[q.Scalar | None, about("amount, in the unit of the kind; null: the default of this kind")] = None
    end: Annotated[bool, about("true: end it")] = False


class Answer(Message, frozen=True, kw_only=True):
    """Reply to every query: whether it was done, and if not, why, as a text and as one stable word."""

    ok: Annotated[bool, about("whether it was done")]
    reason: Annotated[q.Reason, about("a text: why not, or if it was done why the robot is in its state")]
    refusal: Annotated[q.Name | None, about("why not, as one word: see protocol.md; null: it was done")] = None
    epoch: Annotated[q.Count, about("of the lease, or of the last one when it is free")] = 0
    lifecycle: Annotated[LifecycleState, LIFECYCLE] = "disarmed"
    host: Annotated[q.Name | None, HOST] = None


class Done(Message, frozen=True, kw_only=True):
    """`hal/done/<service>`: a lockstep participant has published all its output for a tick."""

    tick: q.Tick


class Process(Message, frozen=True, kw_only=True):
    """`process/<name>-<id>`, latched: one process of the robot's network; valid while a token at the same key lives."""

    name: Annotated[q.Name, about("its role: host, a service of the scenario, recorder, ...")]
    machine: Annotated[q.Name, about("host name of its computer")]
    user: Annotated[q.Name, about("who has started it")]
    pid: Annotated[q.Count, about("its process id there")]
    version: Annotated[q.Name, about("of SnakeSIM, or of the program that writes this")]
    started_unix_s: Annotated[q.Count, about("when it started, by the wall clock of its machine")]
    settings: Annotated[
        dict[q.Name, q.Name],
        Meta(max_length=32),
        about("settings that host and services must share: values, and hashes of sections; empty: it uses none"),
    ] = {}
    messages: Annotated[
        dict[q.Name, Annotated[q.Count, about("version of that message")]],
        Meta(max_length=64),
        about("messages that it knows; empty: unknown"),
    ] = {}
    waits_for: Annotated[
        list[q.Name], Meta(max_length=16), about("keys whose first message it waits for; it publishes nothing before")
    ] = []


# --- guidance, navigation, control -----------------------------------------------------------------------------


class Obstacle(Message, frozen=True, kw_only=True):
    """A known obstacle in the world: an upright shape with its outline."""

    name: q.Name
    shape: Literal["cylinder", "box", "sphere"]
    position_w: Annotated[q.Vector, about("center of the shape")]
    yaw_rad: q.Angle = 0.0
    radius_m: Annotated[q.Length, about("of a cylinder or sphere")] = 0.0
    half_size_m: Annotated[q.Vector, about("of a box")] = (0.0, 0.0, 0.0)
    height_m: q.Length = 0.0
    confidence: q.Fraction = 1.0
    position_sd_m: Annotated[q.Distance, about("standard deviation of `position_w`, horizontally; 0: exact")] = 0.0
    size_sd_m: Annotated[q.Distance, about("standard deviation of `radius_m` or `half_size_m`; 0: exact")] = 0.0
    last_seen_ns: Annotated[
        q.Stamp | None, about("stamp of the newest measurement of it; null: from a map, not from a sensor")
    ] = None
    felt: Annotated[bool, about("the body has touched it")] = False


class WorldContact(Message, frozen=True, kw_only=True):
    """A contact in the world frame, with its position along the body."""

    link: Annotated[q.LinkIndex, about("number of the link, from 0 at the tail")]
    obstacle: Annotated[q.Name | None, about("touched obstacle; null: unknown")]
    body_s_m: Annotated[q.Length, about("arc length from the tail end along the chain")]
    position_w: q.Vector
    normal_w: Annotated[q.UnitVector, about("from the obstacle into the body")]
    tangent_w: Annotated[q.UnitVector, about("across the normal, towards the head")]
    force_w: Annotated[q.ForceVector, about("on the body")]
    confidence: q.Fraction = 1.0


class World(Message, frozen=True, kw_only=True):
    """`guidance/world`: pose of the body, contacts, obstacles nearby. Each part has its own stamp."""

    tick: Annotated[q.Tick, about("of the clock that guidance acted on")]
    timestamp_ns: Annotated[q.Stamp, about("of the joint state that it was computed from")]
    base_position_w: q.Vector
    base_orientation_wxyz: q.Quaternion
    base_confidence: q.Fraction
    contacts: Annotated[list[WorldContact], Meta(max_length=q.MAX_CONTACTS)]
    obstacles: Annotated[list[Obstacle], Meta(max_length=4096)]
    pose_timestamp_ns: Annotated[q.Stamp | None, about("of the pose in it; null: unknown")] = None
    contacts_timestamp_ns: Annotated[
        q.Stamp | None, about("of the contacts in it; null: no sample yet, and no estimate")
    ] = None
    center_w: Annotated[q.Vector | None, about("center of mass of the body; null: unknown")] = None
    base_position_sd_m: Annotated[
        q.Distance | None,
        about(
            "standard deviation of `base_position_w`, horizontally; null: not estimated. If it is, the base's pose is "
            "of `timestamp_ns`, by dead reckoning since `pose_timestamp_ns`"
        ),
    ] = None
    base_yaw_sd_rad: Annotated[
        q.Angle | None, about("standard deviation of the base's heading; null: not estimated")
    ] = None
    depth_timestamp_ns: Annotated[
        q.Stamp | None, about("of the newest image or ranges in `obstacles`; null: none, or a map that is known")
    ] = None
    pose_from: Annotated[
        Literal["sensor", "dead_reckoning"] | None,
        about(
            "present source of the base's pose; its age is that of `pose_timestamp_ns` or `timestamp_ns`; null: unknown"
        ),
    ] = None
    contacts_from: Annotated[
        Literal["sensor", "joint_torques"] | None,
        about(
            "what `contacts` are of: measured, or estimated; their age is that of `contacts_timestamp_ns`; null: none"
        ),
    ] = None


class Rise(Message, frozen=True, kw_only=True):
    """A stretch of a path that lies on a platform."""

    from_s_m: Annotated[q.Distance, about("where it begins, arc length from the begin of the path")]
    to_s_m: Annotated[q.Distance, about("where it ends")]
    height_m: Annotated[q.Distance, about("of the platform's top above the ground")]


class Trajectory(Message, frozen=True, kw_only=True):
    """`navigation/trajectory`: path, speed, and the push-points expected along it."""

    tick: Annotated[q.Tick, about("of the clock that navigation acted on")]
    timestamp_ns: Annotated[q.Stamp | None, about("of the world model that it was planned from; null: without one")]
    path_id: Annotated[q.Count, about("changes when `path_w` does")]
    path_w: Annotated[list[tuple[q.Length, q.Length]], Meta(min_length=2, max_length=20000), about("x and y")]
    speed_m_s: Annotated[q.Velocity, about("along the path; 0: stop")]
    push_points: Annotated[
        list[q.Name], Meta(max_length=512), about("obstacles within reach of the path, in the order along it")
    ]
    finished: Annotated[bool, about("the end of the path is reached")]
    reason: Annotated[q.Reason, about("why the speed is not that of the mission; empty: it is")] = ""
    searching: Annotated[
        q.Reason, about("why another path is being searched, while this one is followed; empty: none is")
    ] = ""
    searched_nodes: Annotated[q.Count, about("work on that search in this turn, in nodes that were expanded")] = 0
    assumed_obstacle_friction: Annotated[
        float, q.from_zero(2, "1 (Coulomb coefficient)"), about("of the obstacles, as the path is planned with it")
    ] = 0.0
    goal_w: Annotated[
        tuple[q.Length, q.Length] | None, about("x and y to which the mission leads the head; null: along the path")
    ] = None
    rises: Annotated[
        list[Rise],
        Meta(max_length=64),
        about("where the path leads over platforms of a map; elsewhere ground is level"),
    ] = []


class ControlState(Message, frozen=True, kw_only=True):
    """`control/state`: the controller's own state, and its reason. Telemetry; nothing depends on it.

    Values that a controller does not know or have are null or empty.
    """

    tick: Annotated[q.Tick, about("of the clock that control acted on")]
    timestamp_ns: q.Stamp
    controller: q.Name
    state: Annotated[LocomotionState, about("PowerOff: the HAL is silent; Idle: not armed, or the speed is to be 0")]
    reason: q.Reason
    path_s_m: Annotated[q.Length | None, about("arc length of the tail along the path; null: unknown")] = None
    propulsion_joint: Annotated[q.Name | None, about("the joint that pushes; null: none does")] = None
    propulsion_n: Annotated[q.Force | None, about("commanded force along the path; null: none")] = None
    push_points: Annotated[list[WorldContact], Meta(max_length=64), about("obstacles that the body pushes off")] = []
    desired_force_n: Annotated[list[q.Force], Meta(max_length=64), about("expected at each of `push_points`")] = []
    measured_force_n: Annotated[
        list[q.Force | None],
        Meta(max_length=64),
        about(
            "measured at the obstacle of each of `push_points`, mean over 50 ms; null: that has no name; or empty: no "
            "sensor of contacts"
        ),
    ] = []
    propulsion_torque_nm: Annotated[q.Torque | None, about("of `propulsion_joint`; null: none pushes")] = None
    bending_torque_nm: Annotated[q.Torques, about("of every joint, for the solved forces; or empty")] = []
    reference_rad: Annotated[q.Angles, about("of every joint, from the path; or empty")] = []
    condition: Annotated[q.Scalar | None, about("condition number of the equations; null: none were solved")] = None
    torque_headroom_nm: Annotated[q.Torque | None, about("left below its limit at full push; null: none pushes")] = None
    saturated: Annotated[bool, about("the push is at its torque limit")] = False
    jammed: Annotated[bool, about("the body is stuck although a joint pushes")] = False
    failed: Annotated[bool, about("the last message of a controller that cannot go on; `reason` is why")] = False
    too_slow: Annotated[
        q.Reason, about("in real time: what shows that the controller misses its deadlines; empty: nothing does")
    ] = ""


class ParametersRequest(Message, frozen=True, kw_only=True):
    """Query payload on `control/parameters`: go on with these parameters of the running controller."""

    requester: Annotated[q.Name, about("name of the requester, for log and record")]
    controller: Annotated[q.Name, about("`ControlParameters.controller`; another one is refused")]
    parameters: Annotated[
        str,
        Meta(max_length=q.MAX_PARAMETERS_JSON),
        about("a JSON object; fields that it leaves out get their defaults"),
    ]


class ControlParameters(Message, frozen=True, kw_only=True):
    """`control/parameters_in_force`, latched: what the controller runs with, and what it could."""

    tick: Annotated[q.Tick, about("since when")]
    timestamp_ns: q.Stamp
    controller: q.Name
    parameters: Annotated[str, Meta(max_length=q.MAX_PARAMETERS_JSON), about("all of them, as a JSON object")]
    schema: Annotated[str, Meta(max_length=q.MAX_SCHEMA), about("JSON Schema of `parameters`, with bounds and units")]
    requester: Annotated[q.Name | None, about("name of the requester of them; null: the configuration of the run")] = (
        None
    )
    changes: Annotated[q.Count, about("how often they have been changed since control started")] = 0


class Intent(Message, frozen=True, kw_only=True):
    """`operator/intent`: speed and direction asked for by a person or a mission. Send it repeatedly: it expires.

    When one that was followed has expired, the robot stops and waits for the next one; it does not return to its
    mission.
    """

    timestamp_ns: Annotated[q.Stamp, about("robot time of the request, from hal/clock")]
    requester: q.Name
    speed_m_s: Annotated[q.Velocity | None, about("null: that of the mission")] = None
    go: Annotated[bool, about("false: stop")] = True
    valid_for_ns: Annotated[q.Nanoseconds, about("valid for this long from `timestamp_ns`, at most 5 s")] = (
        1_000_000_000
    )
    heading_w_rad: Annotated[
        q.Angle | None, about("direction of travel in the world, from its x axis; null: the mission's own goal")
    ] = None


VERSIONS: dict[type[Message], int] = dict.fromkeys(
    (
        JointState,
        Contacts,
        Imu,
        Pose,
        Power,
        DepthImage,
        ColorImage,
        Ranges,
        CustomSample,
        Preview,
        JointCommand,
        AppliedCommand,
        Clock,
        Description,
        Configuration,
        Status,
        LeaseRequest,
        LifecycleRequest,
        EstopRequest,
        SimulatorRequest,
        FaultRequest,
        Answer,
        Done,
        Process,
        World,
        Trajectory,
        ControlState,
        ParametersRequest,
        ControlParameters,
        Intent,
    ),
    1,
)
"""Every message that may be sent on its own, with its version."""
