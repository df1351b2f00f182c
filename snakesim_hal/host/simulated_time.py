"""Controls the time of a simulated robot: paused, step by step, or at another speed.

Leases and ages count in safety time. It pauses with the robot's time, passes with the monotonic clock at speed 1, and
by one period per tick at any other speed, as in lockstep. It never jumps and never goes back, so nothing expires
because of a pause.

Pure; the monotonic clock is passed in. The host's thread makes every call.
"""

from collections.abc import Callable
from typing import NamedTuple

from snakesim_hal.wire.messages import ClockMode, Description, SimulatorRequest

MEASURED_OVER_NS = 1_000_000_000  # of the real-time factor
MIN_SPEED_RATIO = 0.95  # of the requested speed; below, the status reports that it is not reached


class Refusal(NamedTuple):
    """The reason why a request cannot be carried out, as one word and as text."""

    word: str
    why: str


class SimulatedTime:
    """The time of one host's robot. If the time is not simulated, every request is refused, and it never pauses."""

    def __init__(self, description: Description, clock_mode: ClockMode, clock: Callable[[], int]) -> None:
        """Start at speed 1, not paused.

        Args:
            description: of the robot.
            clock_mode: of the run.
            clock: returns the monotonic time in ns.
        """
        self._description = description
        self._clock_mode = clock_mode
        self._clock = clock
        # As requested.
        self.speed = 1.0  # requested robot time per wall time; counts in clock mode realtime
        self.paused_by: str | None = None
        self._steps = 0  # ticks until it pauses again
        # As measured.
        self.real_time_factor: float | None = None  # robot time per wall time, while it passes
        self._measured_since = (clock(), 0)  # monotonic ns, tick
        # Where the present rate of safety time began.
        self._base = (0, 0, 0)  # safety ns, monotonic ns, tick

    @property
    def is_paused(self) -> bool:
        """Return whether robot time is paused: no tick begins."""
        return self.paused_by is not None and self._steps == 0

    def safety_ns(self, tick: int, monotonic_ns: int | None = None) -> int:
        """Return the safety time at a tick, in ns.

        Args:
            tick: the tick.
            monotonic_ns: the moment in that tick; None: now.
        """
        period_ns = self._description.period_ns
        if self._clock_mode == "lockstep":
            return tick * period_ns
        since_ns, since_monotonic_ns, since_tick = self._base
        if self.is_paused:
            return since_ns
        if self.speed != 1.0:
            return since_ns + (tick - since_tick) * period_ns
        at_ns = monotonic_ns or self._clock()
        return since_ns + max(at_ns - since_monotonic_ns, 0)

    def carry_out(self, request: SimulatorRequest, tick: int) -> str | Refusal:
        """Carry out a request at a tick. The caller carries out a `reset`.

        Returns:
            The result as text, or the reason for the refusal.
        """
        refusal = self._find_refusal(request)
        if refusal is not None:
            return refusal
        self._rebase(tick)
        match request.action:
            case "pause":
                self.paused_by = request.requester
                self._steps = 0
                return f"paused by {request.requester}, before tick {tick}"
            case "resume":
                self.paused_by = None
                return f"resumed by {request.requester}, at tick {tick}"
            case "step":
                self.paused_by = request.requester
                self._steps = request.ticks
                return f"{request.ticks} ticks for {request.requester}, then paused before tick {tick + request.ticks}"
            case "speed":
                self.speed = request.speed
                return f"speed {request.speed:g}, as {request.requester} wants"
            case _:
                return f"reset by {request.requester}; arm again"

    def _find_refusal(self, request: SimulatorRequest) -> Refusal | None:
        """Return the reason to refuse a request; None: it can be carried out."""
        robot = self._description
        if not robot.simulated_time:
            if robot.emulated:
                reason = "the time of emulated modules is that of their bus"
            else:
                reason = "it moves something real"
            return Refusal("not_simulated", f"backend {robot.backend!r} cannot {request.action}: {reason}")
        if request.action == "resume" and self.paused_by is None:
            return Refusal("wrong_state", "nothing to resume: it is not paused")
        if request.action == "speed" and self._clock_mode != "realtime":
            explanation = "goes as fast as it can; for a speed start the run with --clock-mode realtime"
            return Refusal("wrong_clock_mode", f"the clock mode is {self._clock_mode}, which {explanation}")
        return None

    def tick_done(self, tick: int) -> None:
        """Count a tick that has ended.

        Args:
            tick: the tick that comes next.
        """
        self._measure_factor(tick)
        if self._steps == 1:
            self._rebase(tick)  # before it pauses, because safety time passes until now
        self._steps = max(self._steps - 1, 0)

    def find_slowness(self) -> list[str]:
        """Return a text that the requested speed is not reached; empty if it is, or if it is 1."""
        if self.speed == 1.0 or self.real_time_factor is None or self.real_time_factor >= MIN_SPEED_RATIO * self.speed:
            return []
        return [f"speed {self.speed:g} is requested, {self.real_time_factor:.2g} reached"]

    def _rebase(self, tick: int) -> None:
        """Begin another rate of safety time, and another measurement, at this tick."""
        now_ns = self._clock()
        self._base = (self.safety_ns(tick, now_ns), now_ns, tick)
        self.real_time_factor = None
        self._measured_since = (now_ns, tick)

    def _measure_factor(self, tick: int) -> None:
        """Update the real-time factor, about once a second."""
        now_ns = self._clock()
        since_ns, since_tick = self._measured_since
        if now_ns - since_ns >= MEASURED_OVER_NS:
            self.real_time_factor = (tick - since_tick) * self._description.period_ns / (now_ns - since_ns)
            self._measured_since = (now_ns, tick)
