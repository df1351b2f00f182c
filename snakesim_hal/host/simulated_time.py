"""Controls the time of a simulated robot: paused, step by step, or at another speed.

Leases and ages count in safety time. It pauses with the robot's time, passes with the monotonic clock at speed 1, and
by one period per tick at any other speed, as in lockstep. It never jumps and never goes back, so nothing expires
because of a pause.

Pure; the monotonic clock is passed in. The host's thread makes every call.
"""

from collections.abc import Callable
from typing import NamedTuple

from snakesim_hal.wire.messages import ClockMode, RobotDescription, SimulatorRequest

FACTOR_MEASUREMENT_NS = 1_000_000_000  # wall time over which the real-time factor is measured
MIN_SPEED_RATIO = 0.95  # of the requested speed; below, the status reports that it is not reached


class SimulatorRefusal(NamedTuple):
    """The reason why a request cannot be carried out, as one word and as text."""

    code: str
    reason: str


class _TimeOrigin(NamedTuple):
    """One moment by three clocks."""

    safety_ns: int
    monotonic_ns: int
    tick: int


class SimulatedTime:
    """Pauses the time of one host's robot, and changes its speed. Converts monotonic time to safety time.

    Robot time is the time of the simulation: the tick times the control period. Safety time is the time by which the
    host decides whether commands and the lease have expired; it does not advance while robot time is paused.

    If the time of the robot is not simulated, every request is refused, and the time never pauses.
    """

    def __init__(
        self,
        description: RobotDescription,
        clock_mode: ClockMode,
        read_monotonic_ns: Callable[[], int],
    ) -> None:
        """Initialize the clock; simulated time runs in real time until a client changes its speed.

        Args:
            description: Description of the robot.
            clock_mode: Clock mode of the run.
            read_monotonic_ns: Function that returns the time of a monotonic clock in ns.
        """
        self._description = description
        self._clock_mode = clock_mode
        self._read_monotonic_ns = read_monotonic_ns
        # Requested by clients.
        self.speed = 1.0  # simulated time per real time; used only in clock mode realtime
        # Client that paused or single-steps the clock; None if time passes.
        self.paused_by: str | None = None
        # Single steps that are still to be made; used only if `paused_by` is set.
        self._remaining_ticks = 0
        # Measured.
        # Simulated time per real time; None if not measured yet.
        self.real_time_factor: float | None = None
        self._measurement_start = _TimeOrigin(safety_ns=0, monotonic_ns=read_monotonic_ns(), tick=0)
        # Start of the time with the current pause and speed, from which safety time is extrapolated.
        self._safety_time_origin = _TimeOrigin(safety_ns=0, monotonic_ns=0, tick=0)

    @property
    def is_paused(self) -> bool:
        """Return whether robot time is paused: no tick begins."""
        return self.paused_by is not None and self._remaining_ticks == 0

    def safety_ns(self, tick: int, monotonic_ns: int | None = None) -> int:
        """Return the safety time at a moment in a tick, in ns.

        Args:
            tick: Tick that contains the moment.
            monotonic_ns: Monotonic time of the moment. None means now.
        """
        period_ns = self._description.period_ns
        if self._clock_mode == "lockstep":
            return tick * period_ns
        origin = self._safety_time_origin
        if self.is_paused:
            return origin.safety_ns
        if self.speed != 1.0:
            return origin.safety_ns + (tick - origin.tick) * period_ns
        moment_ns = monotonic_ns or self._read_monotonic_ns()
        return origin.safety_ns + max(moment_ns - origin.monotonic_ns, 0)

    def execute_request(self, request: SimulatorRequest, tick: int) -> str | SimulatorRefusal:
        """Pause, resume, step, or change the speed as requested. A `reset` is left to the caller.

        Args:
            request: Request of a client.
            tick: Tick that comes next.

        Returns:
            A text about the result, or the refusal.
        """
        refusal = self._find_refusal(request)
        if refusal is not None:
            return refusal
        self._restart_safety_time(tick)
        match request.action:
            case "pause":
                self.paused_by = request.requester
                self._remaining_ticks = 0
                return f"paused by {request.requester}, before tick {tick}"
            case "resume":
                self.paused_by = None
                return f"resumed by {request.requester}, at tick {tick}"
            case "step":
                self.paused_by = request.requester
                self._remaining_ticks = request.ticks
                return f"{request.ticks} ticks for {request.requester}, then paused before tick {tick + request.ticks}"
            case "speed":
                self.speed = request.speed
                return f"speed {request.speed:g}, as {request.requester} wants"
            case _:
                return f"reset by {request.requester}; arm again"

    def _find_refusal(self, request: SimulatorRequest) -> SimulatorRefusal | None:
        """Return why a request cannot be carried out, or None if it can."""
        robot = self._description
        if not robot.simulated_time:
            if robot.emulated:
                reason = "the time of emulated modules is that of their bus"
            else:
                reason = "it moves something real"
            return SimulatorRefusal(
                "not_simulated", f"backend {robot.backend!r} cannot {request.action}: {reason}"
            )
        if request.action == "resume" and self.paused_by is None:
            return SimulatorRefusal("wrong_state", "nothing to resume: it is not paused")
        if request.action == "speed" and self._clock_mode != "realtime":
            explanation = (
                "goes as fast as it can; for a speed start the run with --clock-mode realtime"
            )
            return SimulatorRefusal(
                "wrong_clock_mode", f"the clock mode is {self._clock_mode}, which {explanation}"
            )
        return None

    def on_tick_end(self, tick: int) -> None:
        """Count a tick that has ended, and pause after the last requested one.

        Args:
            tick: Tick that comes next.
        """
        self._measure_real_time_factor(tick)
        if self._remaining_ticks == 1:
            # Before the pause starts, because safety time passes until now.
            self._restart_safety_time(tick)
        self._remaining_ticks = max(self._remaining_ticks - 1, 0)

    def describe_slowness(self) -> list[str]:
        """Return one warning if the requested speed is not reached; an empty list if it is, or if it is 1."""
        if (
            self.speed == 1.0
            or self.real_time_factor is None
            or self.real_time_factor >= MIN_SPEED_RATIO * self.speed
        ):
            return []
        return [f"speed {self.speed:g} is requested, {self.real_time_factor:.2g} reached"]

    def _restart_safety_time(self, tick: int) -> None:
        """Start to count safety time, and to measure the real-time factor, from this tick on."""
        now_ns = self._read_monotonic_ns()
        self._safety_time_origin = _TimeOrigin(self.safety_ns(tick, now_ns), now_ns, tick)
        self.real_time_factor = None
        self._measurement_start = self._safety_time_origin

    def _measure_real_time_factor(self, tick: int) -> None:
        """Update the real-time factor, about once a second."""
        now_ns = self._read_monotonic_ns()
        start = self._measurement_start
        elapsed_ns = now_ns - start.monotonic_ns
        if elapsed_ns >= FACTOR_MEASUREMENT_NS:
            self.real_time_factor = (tick - start.tick) * self._description.period_ns / elapsed_ns
            self._measurement_start = start._replace(monotonic_ns=now_ns, tick=tick)
