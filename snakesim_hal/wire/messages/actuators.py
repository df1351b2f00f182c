"""Setpoints of the joints: as a client commands them, and as the HAL host applies them."""

from typing import Annotated

from msgspec import Meta

from snakesim_hal.wire import quantities as q
from snakesim_hal.wire.messages.base import Message, Modes
from snakesim_hal.wire.quantities import describe


class JointCommand(Message, frozen=True, kw_only=True):
    """`actuator/joints`: setpoints for every joint from the lease holder. The checks are in protocol.md."""

    tick: Annotated[
        q.Tick,
        describe("of the joint state that the command answers: its age is the command's age"),
    ]
    sequence: Annotated[
        q.Count,
        describe("greater than that of any command accepted under this lease; gaps are allowed"),
    ]
    lease_epoch: Annotated[q.Count, describe("`Answer.epoch` of the lease")]
    layout: Annotated[q.Name, describe("`RobotDescription.layout`")]
    valid_for_ns: Annotated[
        q.Nanoseconds,
        describe("rejected as stale this long after the state was published; at most a lease term"),
    ]
    mode: Modes
    target: q.Targets
    torque_limit_nm: Annotated[
        q.TorqueLimits | None,
        describe("limit of each motor, if lower than the robot's own; null: the robot's own"),
    ] = None
    arm_session: Annotated[
        q.Count,
        describe(
            "`Clock.arm_session`; 0: before any arming. An armed robot rejects any number but its own, including 0"
        ),
    ] = 0


class AppliedCommand(Message, frozen=True, kw_only=True):
    """`hal/applied`: the setpoints that the motors got in a tick, and where they differ from the command."""

    tick: q.Tick
    timestamp_ns: q.Stamp
    sequence: Annotated[q.Count | None, describe("of the command; null: the host's own stop mode")]
    mode: Modes
    target: q.Targets
    torque_limit_nm: q.TorqueLimits
    limited: Annotated[
        dict[q.Name, q.Reason],
        Meta(max_length=q.MAX_JOINTS),
        describe(
            "joint -> which limit changed its target: angle, angle_rate, speed, acceleration, torque, torque_rate, "
            "thermal, isolated"
        ),
    ] = {}
