"""Draws trials of killed runs at random: how the run is started, and which processes get which signals when.

The same seed draws the same trials.
"""

import itertools
import random
import signal
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, get_args

Moment = Literal[
    "starting", "arm_session", "armed", "stopping", "resetting", "interrupted", "ending"
]
MOMENTS: tuple[Moment, ...] = get_args(Moment)
BACKENDS = ("sim", "can")
SUPERVISOR = "supervisor"
VICTIMS = (SUPERVISOR, "host", "host", "guidance", "navigation", "control")
# A signal that is listed twice is drawn twice as often.
SIGNALS = (
    signal.SIGKILL,
    signal.SIGKILL,
    signal.SIGSTOP,
    signal.SIGSTOP,
    signal.SIGTERM,
    signal.SIGINT,
)
MAX_DELAY_S: dict[Moment, float] = {  # from the moment to a signal
    "starting": 2.0,
    "arm_session": 1.0,
    "armed": 0.8,
    "stopping": 0.06,
    "resetting": 0.06,
    "interrupted": 0.8,
    "ending": 1.0,
}
KILL_COUNTS = (1, 1, 1, 2, 3)
FREEZE_DURATIONS_S = (0.02, 0.2, 1.0, 3.0, None)
ROUTER_PROBABILITY = 0.25
STAY_PROBABILITY = 0.4
DATAGRAM_PROBABILITY = 0.5
CLOCK_MODES = ("realtime", "realtime", "lockstep")
ENDING_DURATION_S = 1.0
REALTIME_DURATION_S = 8.0
LOCKSTEP_DURATION_S = 60.0  # of robot time, which passes much faster
# The lowest control rate, so that the lease is long: a busy machine must not fail a trial.
RATE_HZ = 50


@dataclass(frozen=True)
class ProcessKill:
    """A signal to one process, some time after the moment of the trial."""

    victim: str
    signal_number: signal.Signals
    delay_s: float
    # From a SIGSTOP to the SIGCONT. None if the process stays frozen until the run is to end.
    freeze_duration_s: float | None = None

    def __str__(self) -> str:
        freeze = "" if self.freeze_duration_s is None else f" for {self.freeze_duration_s:.2f} s"
        return f"{self.signal_number.name} to {self.victim} at +{self.delay_s:.3f} s{freeze}"


@dataclass(frozen=True)
class KillTrial:
    """One run, and the signals that its processes get at a moment of the run."""

    number: int
    backend: str
    clock_mode: str
    stay: bool
    router: bool
    duration_s: float  # for which the run is to be armed
    moment: Moment
    by_datagram: bool  # how the emergency stop is requested
    kills: tuple[ProcessKill, ...]

    @property
    def requested_ticks(self) -> int:
        """The number of control cycles for which the run is to be armed."""
        return round(self.duration_s * RATE_HZ)

    def list_arguments(self) -> list[str]:
        """List the arguments of `snakesim` that start the run."""
        return [
            "triplet",
            "--controller",
            "hold",
            "--set",
            f"rate_hz={RATE_HZ}",
            "--backend",
            self.backend,
            "--clock-mode",
            self.clock_mode,
            "--duration",
            str(self.duration_s),
            *self._list_flags(),
        ]

    def _list_flags(self) -> list[str]:
        flags: list[str] = []
        if self.stay:
            flags.append("--stay")
        if self.router:
            flags.append("--with-router")
        return flags

    def __str__(self) -> str:
        run = " ".join([self.backend, self.clock_mode, *self._list_flags()])
        kills = ", ".join(str(kill) for kill in self.kills)
        return f"#{self.number} {run}, {self.moment}: {kills}"


def draw_trials(seed: int, *, backend: str | None = None) -> Iterator[KillTrial]:
    """Draw trials without end. Moments take turns, and so do backends.

    Args:
        seed: Selects the trials.
        backend: The backend of all trials; None for both.
    """
    chance = random.Random(seed)
    for number in itertools.count():
        moment = MOMENTS[number % len(MOMENTS)]
        router = chance.random() < ROUTER_PROBABILITY
        clock_mode = chance.choice(CLOCK_MODES)
        victims = (*VICTIMS, "router") if router else VICTIMS
        kill_count = chance.choice(KILL_COUNTS)
        kills = [_draw_kill(chance, victims, MAX_DELAY_S[moment]) for _ in range(kill_count)]
        yield KillTrial(
            number=number,
            backend=backend or BACKENDS[number // len(MOMENTS) % len(BACKENDS)],
            clock_mode=clock_mode,
            stay=chance.random() < STAY_PROBABILITY,
            router=router,
            duration_s=_choose_duration_s(moment, clock_mode),
            moment=moment,
            by_datagram=chance.random() < DATAGRAM_PROBABILITY,
            kills=tuple(kills),
        )


def _draw_kill(chance: random.Random, victims: tuple[str, ...], max_delay_s: float) -> ProcessKill:
    number = chance.choice(SIGNALS)
    freeze_duration_s = None
    if number is signal.SIGSTOP:
        freeze_duration_s = chance.choice(FREEZE_DURATIONS_S)
    return ProcessKill(
        victim=chance.choice(victims),
        signal_number=number,
        delay_s=round(chance.uniform(0.0, max_delay_s), 3),
        freeze_duration_s=freeze_duration_s,
    )


def _choose_duration_s(moment: Moment, clock_mode: str) -> float:
    """Choose a duration that ends only in trials about the end."""
    if moment == "ending":
        return ENDING_DURATION_S
    if clock_mode == "realtime":
        return REALTIME_DURATION_S
    return LOCKSTEP_DURATION_S
