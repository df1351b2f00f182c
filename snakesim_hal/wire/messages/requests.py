"""Requests to the HAL host, and its answer."""

from typing import Annotated, Literal

from msgspec import Meta

from snakesim_hal.wire import quantities as q
from snakesim_hal.wire.messages.base import ABOUT_HOST, ABOUT_LIFECYCLE, LifecycleState, Message
from snakesim_hal.wire.messages.description import RobotDescription
from snakesim_hal.wire.quantities import describe


class LeaseRequest(Message, frozen=True, kw_only=True):
    """Query payload on `hal/lease`: the right to command, for a term. Accepted commands renew it."""

    action: Annotated[
        Literal["acquire", "renew", "release"],
        describe("renew works only while disarmed: an armed robot needs commands"),
    ]
    holder: Annotated[
        q.Name, describe("name of the requester; a service of the run uses its own name")
    ]
    epoch: Annotated[
        q.Count, describe("of the lease that is renewed or released; acquire needs none")
    ] = 0
    priority: Annotated[
        int,
        Meta(ge=0, le=255),
        describe("a live lease is taken over only by a greater one, which disarms an armed robot"),
    ] = 100


class LifecycleRequest(Message, frozen=True, kw_only=True):
    """Query payload on `hal/lifecycle`. Arming names robot and backend, so that the wrong one is not armed."""

    action: Annotated[
        Literal["arm", "disarm", "reset", "finish"],
        describe("reset leads from fault or estop to disarmed; finish disarms, and ends the run"),
    ]
    requester: Annotated[q.Name, describe("name of the requester, for status, log and summary")] = (
        "an unnamed client"
    )
    host: Annotated[q.Name | None, describe("id of the addressed host process; null: any")] = None
    robot: Annotated[
        q.Name | None, describe("`RobotDescription.robot`; arm needs it, others may leave it null")
    ] = None
    backend: Annotated[
        q.Name | None,
        describe("`RobotDescription.backend`; arm needs it, others may leave it null"),
    ] = None
    config_hash: Annotated[
        q.Name | None,
        describe("`RobotDescription.config_hash`; arm needs it, others may leave it null"),
    ] = None
    unchecked: Annotated[
        bool,
        describe(
            "arm also if `RobotStatus.unchecked` gives a reason why the joints do not count as checked"
        ),
    ] = False


def make_arm_request(
    robot: RobotDescription, requester: str, *, unchecked: bool = False
) -> LifecycleRequest:
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

    requester: Annotated[q.Name, describe("name of the requester, for status, log and summary")]


class SimulatorRequest(Message, frozen=True, kw_only=True):
    """Query payload on `hal/simulator`: its time. Only for a robot with `RobotDescription.simulated_time`."""

    action: Annotated[
        Literal["pause", "resume", "step", "speed", "reset"],
        describe(
            "step: some ticks, then paused; reset: another host, at the start and disarmed, takes the place of this"
        ),
    ]
    requester: Annotated[q.Name, describe("name of the requester, for status, log and summary")] = (
        "an unnamed client"
    )
    host: Annotated[q.Name | None, describe("id of the addressed host process; null: any")] = None
    ticks: Annotated[int, Meta(ge=1, le=1_000_000), describe("of a step")] = 1
    speed: Annotated[
        q.Speed, describe("robot time per wall time, in real time; 1: as the wall")
    ] = 1.0


class FaultRequest(Message, frozen=True, kw_only=True):
    """Query payload on `fault/<part>`: inject a fault now, or end it. Only in runs that allow it."""

    kind: Annotated[q.Name, describe("kind of fault: `snakesim fault list` prints all")]
    target: Annotated[q.Name, describe("a process, key, joint or bus, such as joint_3")]
    for_s: Annotated[
        Annotated[float, Meta(gt=0, le=86400)] | None,
        describe("seconds of robot time; null: until it is ended"),
    ] = None
    amount: Annotated[
        q.Scalar | None, describe("amount, in the unit of the kind; null: the default of this kind")
    ] = None
    end: Annotated[bool, describe("true: end it")] = False


class Answer(Message, frozen=True, kw_only=True):
    """Reply to every query: whether it was done, and if not, why, as a text and as one stable word."""

    ok: Annotated[bool, describe("whether it was done")]
    reason: Annotated[
        q.Reason, describe("a text: why not, or if it was done why the robot is in its state")
    ]
    refusal: Annotated[
        q.Name | None, describe("why not, as one word: see protocol.md; null: it was done")
    ] = None
    epoch: Annotated[q.Count, describe("of the lease, or of the last one when it is free")] = 0
    lifecycle: Annotated[LifecycleState, ABOUT_LIFECYCLE] = "disarmed"
    host: Annotated[q.Name | None, ABOUT_HOST] = None
