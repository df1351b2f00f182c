"""The robot as its HAL host describes it: joints, links, sensors, and the configuration of the run."""

from typing import Annotated, Literal, get_args

import msgspec
from msgspec import Meta

from snakesim_hal.wire import quantities as q
from snakesim_hal.wire.messages.base import (
    ABOUT_HOST,
    Axis,
    JointMode,
    Measurement,
    Message,
    StopMode,
)
from snakesim_hal.wire.quantities import describe

MAX_CONFIG = 500_000  # characters


class JointDescription(Message, frozen=True, kw_only=True):
    """One joint: its name, its position in every vector, and its limits."""

    name: q.Name
    axis: Annotated[
        Axis, describe("of its rear link about which the joint turns: yaw about z, pitch about y")
    ]
    angle_min_rad: q.Angle
    angle_max_rad: q.Angle
    speed_limit_rad_s: q.AngularVelocity
    acceleration_limit_rad_s2: Annotated[float, Meta(gt=0, le=1e6)]
    torque_limit_nm: q.Torque
    torque_rate_limit_nm_s: Annotated[float, Meta(gt=0, le=1e6)]
    stiffness_nm_per_rad: Annotated[float, Meta(ge=0, le=1e6), describe("of position mode")]
    damping_nm_s_per_rad: Annotated[float, Meta(ge=0, le=1e6), describe("of position mode")]
    velocity_gain_nm_s_per_rad: Annotated[float, Meta(gt=0, le=1e6), describe("of velocity mode")]
    rotor_kg_m2: Annotated[
        float,
        q.from_zero(1e3, "kg·m²"),
        describe("inertia that `torque_nm` turns besides the links; 0: measured beyond the rotor"),
    ] = 0.0
    derate_from_c: Annotated[
        q.Temperature, describe("of the winding: above it torque is derated")
    ] = 80.0
    stop_at_c: Annotated[q.Temperature, describe("of the winding: at it the robot is stopped")] = (
        105.0
    )
    min_voltage_v: Annotated[q.Voltage, describe("below it the robot is stopped")] = 18.0
    modes: Annotated[
        list[JointMode],
        Meta(min_length=1, max_length=4),
        describe("in which it may be commanded; passive it always can be"),
    ] = msgspec.field(default_factory=lambda: list(JointMode))
    measures: Annotated[
        list[Measurement],
        Meta(max_length=8),
        describe(
            "beside angle and velocity; a torque that is not measured is 0, heat and voltage then stop nothing"
        ),
    ] = msgspec.field(default_factory=lambda: list(get_args(Measurement)))
    watchdog: Annotated[
        bool,
        describe(
            "its drive stops by itself without setpoints; false: it holds its last angle if the host dies"
        ),
    ] = True
    serial: Annotated[
        str, Meta(max_length=64), describe("serial number that its drive reports; empty: none")
    ] = ""
    firmware: Annotated[
        str, Meta(max_length=64), describe("firmware version that its drive reports; empty: none")
    ] = ""

    def supports_mode(self, mode: JointMode) -> bool:
        """Return whether the joint may be commanded in a mode. It can always be passive."""
        return mode in self.modes or mode is JointMode.PASSIVE


class LinkDescription(Message, frozen=True, kw_only=True):
    """One rigid link, tail to head: a capsule along its own x axis."""

    name: q.Name
    length_m: q.Length
    radius_m: q.Length
    mass_kg: Annotated[float, Meta(gt=0, le=1e4)]


class SensorDescription(Message, frozen=True, kw_only=True):
    """A sensor and its rate; for IMUs the rate of each link, which need not be sampled together."""

    key: Annotated[
        q.Name,
        describe("where it is published, such as sensor/pose; only listed keys are published"),
    ]
    rate_hz: Annotated[float, Meta(gt=0, le=1e5)]
    delay_s: Annotated[float, Meta(ge=0, le=10)]


class RobotDescription(Message, frozen=True, kw_only=True):
    """`hal/description`, latched: the robot, as described by its backend. Only this defines the order of joints."""

    robot: q.Name
    backend: Annotated[q.Name, describe("name of the backend: sim, can, ...")]
    layout: Annotated[
        q.Name, describe("hash of the joints' names, order and axes; every command carries it")
    ]
    config_hash: Annotated[
        q.Name, describe("of the whole configuration; a request to arm carries it")
    ]
    period_ns: Annotated[q.Nanoseconds, describe("from tick to tick")]
    lease_ns: Annotated[
        q.Nanoseconds, describe("a lease term: how long one accepted command keeps the robot armed")
    ]
    max_step_rad: Annotated[
        float, Meta(gt=0, le=10), describe("a position target further from the measured is limited")
    ]
    stop_mode: Annotated[
        StopMode, describe("in fault: passive, brake (damp), or decelerate and then hold")
    ]
    max_isolated_joints: Annotated[
        int,
        Meta(ge=0, le=q.MAX_JOINTS),
        describe("how many may fail while armed before the robot stops"),
    ] = 0
    emulated: Annotated[
        bool,
        describe(
            "nothing real moves: a simulator, or emulated modules; fault injection is allowed"
        ),
    ] = False
    simulated_time: Annotated[
        bool,
        describe(
            "a simulator: its time can stand, pass by single ticks, faster or slower, and start over"
        ),
    ] = False
    hardware: Annotated[
        str,
        Meta(max_length=200),
        describe("hardware that it drives, such as `can0+can1`; empty: none"),
    ] = ""
    host: Annotated[q.Name | None, ABOUT_HOST] = None
    proof: Annotated[
        str, Meta(max_length=64), describe("for the run that started the host; of no use to others")
    ] = ""
    arithmetic: Annotated[
        dict[q.Name, q.Name],
        Meta(max_length=8),
        describe(
            "hashes of what the host's BLAS, NumPy and C library compute: where they are equal, digests can be"
        ),
    ] = {}
    laws: Annotated[
        Literal["c", "python"] | None,
        describe(
            "in which language a simulator computes ground and friction, with equal results; null: no simulator"
        ),
    ] = None
    joints: Annotated[
        list[JointDescription],
        Meta(min_length=1, max_length=q.MAX_JOINTS),
        describe("tail to head"),
    ]
    links: Annotated[
        list[LinkDescription],
        Meta(min_length=2, max_length=q.MAX_JOINTS + 1),
        describe("tail to head: joint i, from 0, connects link i and link i + 1"),
    ]
    sensors: Annotated[list[SensorDescription], Meta(max_length=48)]
    custom: Annotated[
        dict[q.Name, Annotated[str, Meta(max_length=q.MAX_CUSTOM_SCHEMA)]],
        Meta(max_length=q.MAX_CUSTOM_SENSORS),
        describe(
            "key -> JSON Schema of its message, of each sensor with a custom message, from any process"
        ),
    ] = {}


class RunConfiguration(Message, frozen=True, kw_only=True):
    """`hal/config`, latched: the effective configuration of the run, which explains a recording."""

    config_hash: Annotated[q.Name, describe("as in the description")]
    content: Annotated[
        str, Meta(max_length=MAX_CONFIG), describe("JSON, as `schemas/files/run.json` describes it")
    ]
