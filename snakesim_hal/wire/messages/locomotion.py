"""Messages of guidance, navigation and control, and the intent of an operator."""

from typing import Annotated, Literal

from msgspec import Meta

from snakesim_hal.wire import quantities as q
from snakesim_hal.wire.messages.base import LocomotionState, Message
from snakesim_hal.wire.quantities import describe


class KnownObstacle(Message, frozen=True, kw_only=True):
    """A known obstacle in the world: an upright shape with its outline."""

    name: q.Name
    shape: Literal["cylinder", "box", "sphere"]
    position_w: Annotated[q.Vector, describe("center of the shape")]
    yaw_rad: q.Angle = 0.0
    radius_m: Annotated[q.Length, describe("of a cylinder or sphere")] = 0.0
    half_size_m: Annotated[q.Vector, describe("of a box")] = (0.0, 0.0, 0.0)
    height_m: q.Length = 0.0
    confidence: Annotated[q.Fraction, describe("1: measured (less: estimated)")] = 1.0
    position_sd_m: Annotated[
        q.Distance, describe("standard deviation of `position_w`, horizontally (0: exact)")
    ] = 0.0
    size_sd_m: Annotated[
        q.Distance, describe("standard deviation of `radius_m` or `half_size_m` (0: exact)")
    ] = 0.0
    last_seen_ns: Annotated[
        q.Stamp | None,
        describe("stamp of the newest measurement of it (null: from a map, not from a sensor)"),
    ] = None
    touched: Annotated[bool, describe("the body has touched it")] = False


class WorldContact(Message, frozen=True, kw_only=True):
    """A contact in the world frame, with its position along the body."""

    link: Annotated[q.LinkIndex, describe("number of the link, from 0 at the tail")]
    obstacle: Annotated[q.Name | None, describe("touched obstacle (null: unknown)")]
    body_s_m: Annotated[q.Length, describe("arc length from the tail end along the chain")]
    position_w: Annotated[q.Vector, describe("where the body touches the obstacle")]
    normal_w: Annotated[q.UnitVector, describe("from the obstacle into the body")]
    tangent_w: Annotated[q.UnitVector, describe("across the normal, towards the head")]
    force_w: Annotated[q.ForceVector, describe("on the body")]
    confidence: Annotated[q.Fraction, describe("1: measured (less: estimated)")] = 1.0


class WorldModel(Message, frozen=True, kw_only=True):
    """`guidance/world`: pose of the body, contacts, obstacles nearby. Each part has its own stamp."""

    tick: Annotated[q.Tick, describe("of the clock that guidance acted on")]
    timestamp_ns: Annotated[q.Stamp, describe("of the joint state that it was computed from")]
    base_position_w: Annotated[q.Vector, describe("of the tail end")]
    base_orientation_wxyz: Annotated[q.Quaternion, describe("of the tail link")]
    base_confidence: Annotated[q.Fraction, describe("of the base's pose")]
    contacts: Annotated[
        list[WorldContact], Meta(max_length=q.MAX_CONTACTS), describe("of the body with obstacles")
    ]
    obstacles: Annotated[
        list[KnownObstacle], Meta(max_length=4096), describe("in the neighborhood of the body")
    ]
    pose_timestamp_ns: Annotated[q.Stamp | None, describe("of the pose in it (null: unknown)")] = (
        None
    )
    contacts_timestamp_ns: Annotated[
        q.Stamp | None, describe("of the contacts in it (null: no sample yet, and no estimate)")
    ] = None
    center_w: Annotated[q.Vector | None, describe("center of mass of the body (null: unknown)")] = (
        None
    )
    base_position_sd_m: Annotated[
        q.Distance | None,
        describe(
            "standard deviation of `base_position_w`, horizontally (null: not estimated). If it is, the base's pose is "
            "of `timestamp_ns`, by dead reckoning since `pose_timestamp_ns`"
        ),
    ] = None
    base_yaw_sd_rad: Annotated[
        q.Angle | None, describe("standard deviation of the base's heading (null: not estimated)")
    ] = None
    depth_timestamp_ns: Annotated[
        q.Stamp | None,
        describe(
            "of the newest image or ranges in `obstacles` (null: none, or a map that is known)"
        ),
    ] = None
    pose_from: Annotated[
        Literal["sensor", "dead_reckoning"] | None,
        describe(
            "present source of the base's pose, measured at `pose_timestamp_ns` or `timestamp_ns` (null: unknown)"
        ),
    ] = None
    contacts_from: Annotated[
        Literal["sensor", "joint_torques"] | None,
        describe(
            "what `contacts` are of: measured, or estimated, at `contacts_timestamp_ns` (null: none)"
        ),
    ] = None


class PathRise(Message, frozen=True, kw_only=True):
    """A stretch of a path that lies on a platform."""

    from_s_m: Annotated[
        q.Distance, describe("where it begins, arc length from the begin of the path")
    ]
    to_s_m: Annotated[q.Distance, describe("where it ends")]
    height_m: Annotated[q.Distance, describe("of the platform's top above the ground")]


class Trajectory(Message, frozen=True, kw_only=True):
    """`navigation/trajectory`: path, speed, and the push-points expected along it."""

    tick: Annotated[q.Tick, describe("of the clock that navigation acted on")]
    timestamp_ns: Annotated[
        q.Stamp | None, describe("of the world model that it was planned from (null: without one)")
    ]
    path_id: Annotated[q.Count, describe("changes when `path_w` does")]
    path_w: Annotated[
        list[tuple[q.Length, q.Length]], Meta(min_length=2, max_length=20000), describe("x and y")
    ]
    speed_m_s: Annotated[q.Velocity, describe("along the path (0: stop)")]
    push_points: Annotated[
        list[q.Name],
        Meta(max_length=512),
        describe("obstacles within reach of the path, in the order along it"),
    ]
    finished: Annotated[bool, describe("the end of the path is reached")]
    reason: Annotated[
        q.Reason, describe("why the speed is not that of the mission (empty: it is)")
    ] = ""
    searching: Annotated[
        q.Reason,
        describe("why another path is being searched, while this one is followed (empty: none is)"),
    ] = ""
    searched_nodes: Annotated[
        q.Count, describe("nodes that this search expanded since the last message")
    ] = 0
    assumed_obstacle_friction: Annotated[
        float,
        q.from_zero(2, "1 (Coulomb coefficient)"),
        describe("of the obstacles, as the path is planned with it"),
    ] = 0.0
    goal_w: Annotated[
        tuple[q.Length, q.Length] | None,
        describe("x and y to which the mission leads the head (null: along the path)"),
    ] = None
    rises: Annotated[
        list[PathRise],
        Meta(max_length=64),
        describe("where the path leads over platforms of a map (elsewhere ground is level)"),
    ] = []


class ControlState(Message, frozen=True, kw_only=True):
    """`control/state`: the controller's own state, and its reason. Telemetry; nothing depends on it.

    Values that a controller does not know or have are null or empty.
    """

    tick: Annotated[q.Tick, describe("of the clock that control acted on")]
    timestamp_ns: q.Stamp
    controller: q.Name
    state: Annotated[
        LocomotionState,
        describe("PowerOff: the HAL is silent; Idle: not armed, or the speed is to be 0"),
    ]
    reason: q.Reason
    path_s_m: Annotated[
        q.Length | None, describe("arc length of the tail along the path (null: unknown)")
    ] = None
    propulsion_joint: Annotated[
        q.Name | None, describe("the joint that pushes (null: none does)")
    ] = None
    propulsion_n: Annotated[
        q.Force | None, describe("commanded force along the path (null: none)")
    ] = None
    push_points: Annotated[
        list[WorldContact], Meta(max_length=64), describe("obstacles that the body pushes off")
    ] = []
    desired_force_n: Annotated[
        list[q.Force], Meta(max_length=64), describe("expected at each of `push_points`")
    ] = []
    measured_force_n: Annotated[
        list[q.Force | None],
        Meta(max_length=64),
        describe(
            "measured at the obstacle of each of `push_points`, mean over 50 ms; null: that has no name; or empty: no "
            "sensor of contacts"
        ),
    ] = []
    propulsion_torque_nm: Annotated[
        q.Torque | None, describe("of `propulsion_joint` (null: none pushes)")
    ] = None
    bending_torque_nm: Annotated[
        q.Torques, describe("of every joint, for the desired forces; or empty")
    ] = []
    reference_rad: Annotated[q.Angles, describe("of every joint, from the path; or empty")] = []
    condition: Annotated[
        q.Scalar | None, describe("condition number of the equations (null: none were solved)")
    ] = None
    torque_headroom_nm: Annotated[
        q.Torque | None, describe("left below its limit at full push (null: none pushes)")
    ] = None
    saturated: Annotated[bool, describe("the push is at its torque limit")] = False
    jammed: Annotated[bool, describe("the body is stuck although a joint pushes")] = False
    custom: Annotated[
        dict[q.Name, q.Scalar], Meta(max_length=32), describe("numbers that the controller defines")
    ] = {}
    failed: Annotated[
        bool, describe("the last message of a controller that cannot continue; `reason` is why")
    ] = False
    too_slow: Annotated[
        q.Reason,
        describe(
            "in real time: what shows that the controller misses its deadlines (empty: nothing does)"
        ),
    ] = ""


class ParametersRequest(Message, frozen=True, kw_only=True):
    """Query payload on `control/parameters`: set the parameters of the running controller."""

    requester: Annotated[q.Name, describe("name of the requester, for log and record")]
    controller: Annotated[
        q.Name, describe("`ControlParameters.controller`; another one is refused")
    ]
    parameters: Annotated[
        str,
        Meta(max_length=q.MAX_PARAMETERS_JSON),
        describe("a JSON object; fields that it leaves out get their defaults"),
    ]


class ControlParameters(Message, frozen=True, kw_only=True):
    """`control/parameters_in_force`, latched: what the controller runs with, and what it could."""

    tick: Annotated[q.Tick, describe("since when")]
    timestamp_ns: q.Stamp
    controller: q.Name
    parameters: Annotated[
        str, Meta(max_length=q.MAX_PARAMETERS_JSON), describe("all of them, as a JSON object")
    ]
    schema: Annotated[
        str,
        Meta(max_length=q.MAX_SCHEMA),
        describe("JSON Schema of `parameters`, with bounds and units"),
    ]
    requester: Annotated[
        q.Name | None,
        describe("name of the requester of them (null: the configuration of the run)"),
    ] = None
    changes: Annotated[
        q.Count, describe("how often they have been changed since control started")
    ] = 0


class LocomotionIntent(Message, frozen=True, kw_only=True):
    """`operator/intent`: speed and direction that a person or a mission requests. Send it repeatedly: it expires.

    When one that was followed has expired, the robot stops and waits for the next one; it does not return to its
    mission.
    """

    timestamp_ns: Annotated[q.Stamp, describe("robot time of the request, from hal/clock")]
    requester: q.Name
    speed_m_s: Annotated[q.Velocity | None, describe("null: that of the mission")] = None
    go: Annotated[bool, describe("false: stop")] = True
    valid_for_ns: Annotated[
        q.Nanoseconds, describe("valid for this long from `timestamp_ns`, at most 5 s")
    ] = 1_000_000_000
    heading_w_rad: Annotated[
        q.Angle | None,
        describe(
            "direction of travel in the world, from its x axis (null: the mission's own goal)"
        ),
    ] = None
