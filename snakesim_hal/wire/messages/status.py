"""The state of the HAL host and of the processes on the network of a robot."""

from typing import Annotated

from msgspec import Meta

from snakesim_hal.wire import quantities as q
from snakesim_hal.wire.messages.base import (
    ABOUT_CLOCK_MODE,
    ABOUT_HOST,
    ABOUT_LIFECYCLE,
    ClockMode,
    FaultScope,
    LifecycleState,
    Message,
)
from snakesim_hal.wire.quantities import describe


class Clock(Message, frozen=True, kw_only=True):
    """`hal/clock`: the only clock of GNC, and an index of everything published so far.

    It is published last, so a reader that uses the samples named by `newest` reads the same data in every lockstep run.
    """

    tick: q.Tick
    timestamp_ns: Annotated[q.Stamp, describe("robot time: `tick` x `period_ns`")]
    period_ns: q.Nanoseconds
    clock_mode: Annotated[ClockMode, ABOUT_CLOCK_MODE]
    lifecycle: Annotated[LifecycleState, ABOUT_LIFECYCLE]
    arm_session: Annotated[
        q.Count,
        describe(
            "how often the robot has been armed since its host started; a new number: reset the controller"
        ),
    ]
    lease_epoch: Annotated[q.Count, describe("of the live lease (0: there is none)")]
    newest: Annotated[
        dict[q.Name, q.Tick],
        Meta(max_length=64),
        describe("sensor key or service -> tick of its newest sample that is valid now"),
    ]
    paused: Annotated[
        bool,
        describe(
            "true: not a new tick; the last clock is repeated as a sign of life while robot time is paused"
        ),
    ] = False


class Fault(Message, frozen=True, kw_only=True):
    """One fault, and its location."""

    tick: q.Tick
    what: Annotated[
        q.Name, describe("a short word to count by: lease_expired, service_lost, diverged, ...")
    ]
    cause: Annotated[q.Reason, describe("in words, for the operator")]
    joint: Annotated[q.Name | None, describe("null: it is not about one joint")] = None
    scope: Annotated[
        FaultScope,
        describe(
            "joint: no other is affected, and the robot may continue if its file allows it (none: it stops nothing)"
        ),
    ] = "robot"


class TimingStatistics(Message, frozen=True, kw_only=True):
    """How long something took, many times: percentiles to 5 %, and a histogram on a logarithmic scale."""

    count: Annotated[q.Count, describe("how many were measured")]
    median_us: q.Microseconds
    p99_us: Annotated[q.Microseconds, describe("99 % took no longer")]
    max_us: q.Microseconds
    low_us: Annotated[
        q.Microseconds, describe("where the first bin begins; it counts all that is below, too")
    ]
    bin_decades: Annotated[
        float, q.from_zero(8.0, "1"), describe("width of a bin: log10 of its end over its begin")
    ]
    bins: Annotated[list[q.Count], Meta(max_length=64)]


TICK_TIMES = {  # of `RobotStatus.tick_times`
    "cycle": "from tick to tick",
    "late": "begin of a tick after its deadline",
    "read": "the backend reads its sensors",
    "write": "the backend takes setpoints",
}


class RobotStatus(Message, frozen=True, kw_only=True):
    """`hal/status`, latched: the state of the robot, and its reason.

    `StatusReporter` in the host fills it in. A new field needs a default, so that older messages remain valid.
    """

    tick: q.Tick
    timestamp_ns: q.Stamp
    robot: q.Name
    backend: q.Name
    clock_mode: Annotated[ClockMode, ABOUT_CLOCK_MODE]
    rate_hz: Annotated[float, Meta(gt=0, le=1e5)]
    lifecycle: Annotated[LifecycleState, ABOUT_LIFECYCLE]
    reason: Annotated[
        q.Reason, describe("why it is in this state, and while disarmed what prevents arming")
    ]
    lease_holder: Annotated[q.Name | None, describe("null: the lease is free")]
    lease_epoch: Annotated[q.Count, describe("of the lease, or of the last one when it is free")]
    commands_accepted: Annotated[
        q.Count, describe("commands that the limiter accepted while armed")
    ]
    commands_standby: Annotated[
        q.Count, describe("valid commands while disarmed: received, not enacted")
    ]
    commands_rejected: Annotated[
        dict[q.Name, q.Count], Meta(max_length=64), describe("how many, by reason")
    ]
    commands_limited: Annotated[
        dict[q.Name, q.Count], Meta(max_length=64), describe("how many targets, by limit")
    ]
    faults: Annotated[
        list[Fault],
        Meta(max_length=64),
        describe("since the last reset; not all of them stop the robot"),
    ]
    alive: Annotated[
        list[q.Name], Meta(max_length=64), describe("services of the run with a liveliness token")
    ]
    waiting_for: Annotated[
        list[q.Name], Meta(max_length=64), describe("services that arming waits for")
    ]
    overruns: Annotated[q.Count, describe("ticks that were late, while armed in real time")]
    ready_to_arm: Annotated[
        bool, describe("whether a request to arm that names the right robot would be granted now")
    ]
    injected: Annotated[
        list[q.Reason], Meta(max_length=64), describe("injected faults that are active now")
    ] = []
    realtime_warnings: Annotated[
        list[q.Reason], Meta(max_length=16), describe("real-time measures that the system refused")
    ] = []
    derated: Annotated[
        dict[q.Name, q.Fraction],
        Meta(max_length=q.MAX_JOINTS),
        describe("joint -> share of its torque left by derating"),
    ] = {}
    isolated: Annotated[
        list[q.Name],
        Meta(max_length=q.MAX_JOINTS),
        describe("joints that failed, and are passive until a reset"),
    ] = []
    host: Annotated[q.Name | None, ABOUT_HOST] = None
    faults_left_out: Annotated[
        q.Count, describe("of `faults`, between the first and the newest")
    ] = 0
    paused_by: Annotated[
        q.Name | None, describe("client that paused the simulator (null: it is not paused)")
    ] = None
    speed: Annotated[
        q.Speed, describe("requested speed in real time: robot time per wall time")
    ] = 1.0
    real_time_factor: Annotated[
        Annotated[float, q.from_zero(1e6, "1")] | None,
        describe(
            "robot time per wall time over the last second (null: not measured, such as in a pause)"
        ),
    ] = None
    tick_times: Annotated[
        dict[q.Name, TimingStatistics],
        Meta(max_length=8),
        describe(
            "while armed. cycle: from the begin of a tick to the next one's; late: begin of a tick after its deadline, "
            "in real time; read, write: the backend's calls"
        ),
    ] = {}
    unchecked: Annotated[
        q.Reason,
        describe(
            "why arming needs the flag `unchecked`: its joints were not checked as they are now (empty: it does not)"
        ),
    ] = ""
    held_up: Annotated[
        q.Reason,
        describe(
            "which answer to which tick lockstep has been waiting for, if longer than half a second"
        ),
    ] = ""


class TickDone(Message, frozen=True, kw_only=True):
    """`hal/done/<service>`: a lockstep participant has published all its output for a tick."""

    tick: q.Tick


class ProcessInfo(Message, frozen=True, kw_only=True):
    """`process/<name>-<id>`, latched: one process of the robot's network; valid while a token at the same key lives."""

    name: Annotated[q.Name, describe("its role: host, a service of the scenario, recorder, ...")]
    machine: Annotated[q.Name, describe("host name of its computer")]
    user: Annotated[q.Name, describe("the user who started it")]
    pid: Annotated[q.Count, describe("its process id there")]
    version: Annotated[q.Name, describe("of SnakeSIM, or of the program that writes this")]
    started_unix_s: Annotated[
        q.Count, describe("when it started, by the wall clock of its machine")
    ]
    settings: Annotated[
        dict[q.Name, q.Name],
        Meta(max_length=q.MAX_SHARED_SETTINGS),
        describe(
            "settings that host and services must share: values, and hashes of long ones (empty: it uses none)"
        ),
    ] = {}
    messages: Annotated[
        dict[q.Name, Annotated[q.Count, describe("version of that message")]],
        Meta(max_length=64),
        describe("messages that it knows (empty: unknown)"),
    ] = {}
    waits_for: Annotated[
        list[q.Name],
        Meta(max_length=16),
        describe("keys whose first message it waits for; it publishes nothing before"),
    ] = []
