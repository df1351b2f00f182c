"""What messages of several topics have in common: their base class, states, modes, and texts about fields."""

from enum import IntEnum
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from snakesim_hal.wire import quantities as q
from snakesim_hal.wire.quantities import describe

ClockMode = Literal["realtime", "lockstep", "free"]
LifecycleState = Literal["disarmed", "armed", "fault", "estop"]
LocomotionState = Literal["PowerOff", "Idle", "NotLocomoting", "Locomoting"]
StopMode = Literal["passive", "damp", "hold"]
FaultScope = Literal["robot", "joint", "none"]
Axis = Literal["yaw", "pitch"]
Measurement = Literal["torque", "temperature", "voltage"]

# Meanings of fields that several messages have.
ONE_PER_JOINT = "one entry a joint"
ABOUT_CLOCK_MODE = describe(
    "realtime: by the wall clock; lockstep: each tick waits for all services; free: without waiting"
)
ABOUT_LIFECYCLE = describe(
    "motors follow commands only in armed; fault and estop stay until a reset"
)
ABOUT_HOST = describe("random id of the host process, new at each start; null: unknown")


class JointMode(IntEnum):
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


Modes = Annotated[list[JointMode], Meta(max_length=q.MAX_JOINTS), describe(ONE_PER_JOINT)]


class Message(msgspec.Struct, frozen=True):
    """Base of everything on the wire. Unknown fields are ignored, so that fields can be added."""
