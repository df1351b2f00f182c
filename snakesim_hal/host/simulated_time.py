"""The time of a simulated robot: paused, step by step, or at another speed. Pure; the monotonic clock is passed in.

Safety time, in which leases and ages count, follows: it stands while the robot's time stands, passes with the monotonic
clock at speed 1, and by a period a tick at any other speed, as in lockstep. It never jumps and never goes back, so
nothing expires because somebody has paused, and what held before holds in robot time.
"""

from collections.abc import Callable
from typing import NamedTuple

from snakesim_hal.wire.messages import ClockMode, Description, SimulatorRequest

MEASURED_OVER_NS = 1_000_000_000  # of the real-time factor
KEEPS_UP = 0.95  # share of the wanted speed


class Refusal(NamedTuple):
    """Why a request cannot be done: as one word, and as text."""

    word: str
    why: str


class SimulatedTime:
    """Of one host. A robot whose time is not simulated refuses every request, and never stands still."""

    def __init__(self, description: Description, clock_mode: ClockMode, clock: Callable[[], int]) -> None:
        """clock_mode: of the run; clock: the monotonic one, in ns."""
        self._description, self._clock_mode, self._clock = description, clock_mode, clock
        self.speed = 1.0  # of robot time, as wanted; in real time
        self.paused_by: str | None = None
        self.factor: float | None = None  # robot time per wall time, measured while it passes
        self._steps = 0  # ticks until it stands again
        self._base = (0, 0, 0)  # safety ns, monotonic ns, tick: where the present rate of safety time began
        self._measured_since = (clock(), 0)  # monotonic ns, tick

    @property
    def stands(self) -> bool:
        """Whether no tick begins."""
        return self.paused_by is not None and self._steps == 0

    def safety_ns(self, tick: int, monotonic_ns: int | None = None) -> int:
        """Safety time at a tick, at an instant; None: now."""
        period_ns = self._description.period_ns
        if self._clock_mode == "lockstep":
            return tick * period_ns
        since_ns, since_monotonic_ns, since_tick = self._base
        if self.stands:
            return since_ns
        if self.speed != 1.0:
            return since_ns + (tick - since_tick) * period_ns
        return since_ns + max((monotonic_ns or self._clock()) - since_monotonic_ns, 0)

    def take(self, request: SimulatorRequest, tick: int) -> str | Refusal:
        """Carry a request out, at a tick. Returns what has become of it; a `reset` is left to the caller."""
        if (refusal := self._refusal(request)) is not None:
            return refusal
        self._rebase(tick)
        match request.action:
            case "pause":
                self.paused_by, self._steps = request.who, 0
                return f"paused by {request.who}, before tick {tick}"
            case "resume":
                self.paused_by = None
                return f"resumed by {request.who}, at tick {tick}"
            case "step":
                self.paused_by, self._steps = request.who, request.ticks
                return f"{request.ticks} ticks for {request.who}, then paused before tick {tick + request.ticks}"
            case "speed":
                self.speed = request.speed
                return f"speed {request.speed:g}, as {request.who} wants"
            case _:
                return f"reset by {request.who}; arm again"

    def _refusal(self, request: SimulatorRequest) -> Refusal | None:
        robot = self._description
        if not robot.simulated_time:
            what = "the time of emulated modules is that of their bus" if robot.emulated else "it moves something real"
            return Refusal("not_simulated", f"backend {robot.backend!r} cannot {request.action}: {what}")
        if request.action == "resume" and self.paused_by is None:
            return Refusal("wrong_state", "nothing to resume: it is not paused")
        if request.action == "speed" and self._clock_mode != "realtime":
            fast = "goes as fast as it can; for a speed start the run with --clock-mode realtime"
            return Refusal("wrong_pace", f"the clock mode is {self._clock_mode}, which {fast}")
        return None

    def tick_done(self, tick: int) -> None:
        """A tick has ended, and `tick` comes next."""
        self._measure(tick)
        if self._steps == 1:
            self._rebase(tick)  # while it does not stand yet
        self._steps = max(self._steps - 1, 0)

    def slow(self) -> list[str]:
        """That the wanted speed is not reached, in words; empty: it is, or is that of the wall clock."""
        if self.speed == 1.0 or self.factor is None or self.factor >= KEEPS_UP * self.speed:
            return []
        return [f"speed {self.speed:g} is wanted, {self.factor:.2g} reached"]

    def _rebase(self, tick: int) -> None:
        """Another rate of safety time may begin."""
        now_ns = self._clock()
        self._base = self.safety_ns(tick, now_ns), now_ns, tick
        self.factor, self._measured_since = None, (now_ns, tick)

    def _measure(self, tick: int) -> None:
        now_ns, (since_ns, since_tick) = self._clock(), self._measured_since
        if now_ns - since_ns >= MEASURED_OVER_NS:
            self.factor = (tick - since_tick) * self._description.period_ns / (now_ns - since_ns)
            self._measured_since = now_ns, tick
