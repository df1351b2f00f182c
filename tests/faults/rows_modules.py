"""Joint modules and buses that fail, through the product's own injector.

Those of CAN alone are measured at the driver, with module twins on a virtual bus, in periods of robot time: stepped, so
that the machine's load does not count. What sensors of any backend can do is measured through a whole robot.
"""

import random
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

import numpy as np

from snakesim_can_backend.protocol import ModuleState
from snakesim_hal.backend import SetPoints
from snakesim_hal.errors import BackendError
from snakesim_hal.injection import Injection, checked
from tests.faults.observer import TrialError
from tests.faults.robot import recovered, robot
from tests.faults.row import Measure, Request, Trial
from tests.unit.can_backend.loop import JOINTS, Loop, config, loop

PERIOD_MS = 10.0
BOOT_TICKS = 15  # of the twins, before their first Sync counts
MOST_TICKS = 40  # until a fault must have been found
REST_TICKS = 40  # until all joints must be at rest
CLEAR_TICKS = 12
AT_REST_RAD_S = 0.05
ASKED_FOR_S = 0.3
HARMLESS = 5  # periods after an arming in which nothing new may be wrong


class PacedLoop(Loop):
    """In real time: stepped twins live from Sync to Sync, and stand still on a bus that is cut."""

    due_s = 0.0

    def run(self, ticks: int, wish: Callable[[int], SetPoints] | None = None) -> None:
        """So many periods of wall time."""
        for _ in range(ticks):
            super().run(1, wish)
            now_s = time.monotonic()
            self.due_s = max(self.due_s + PERIOD_MS / 1000, now_s)
            time.sleep(self.due_s - now_s)


@contextmanager
def paced_loop() -> Iterator[Loop]:
    """Open, and close at the end."""
    with loop(config(pace="realtime")) as opened:
        yield PacedLoop(opened.backend, opened.config)


def at_driver(kind: str, what: str, *, paced: bool = False) -> Measure:
    """A fault of joint_N or bus_1 on CAN. what: the name that the driver gives it.

    The value: from the moment right after the module answered, the worst, to the safe action on the bus.
    """

    def measure(request: Request) -> Iterator[Trial]:
        rng = random.Random(5)
        opened: AbstractContextManager[Loop] = paced_loop() if paced else loop()
        request.note(
            "measured at the driver in periods of robot time, "
            + ("which go with the wall clock" if paced else "stepped, whatever the machine's load")
        )
        with opened as run:
            run.run(BOOT_TICKS)
            for _ in range(request.trials):
                joint = rng.randrange(JOINTS)
                target = "bus_1" if kind in BUS_KINDS else f"joint_{joint + 1}"
                yield _trial(run, checked(Injection(kind, target)), what, rng, request)

    return measure


BUS_KINDS = ("cut", "bus_off", "error_passive", "overflow", "full")


def _trial(run: Loop, injection: Injection, what: str, rng: random.Random, request: Request) -> Trial:
    run.wanted, run.faults = None, []
    run.arm()
    run.run(rng.randrange(20, 50), run.waving)
    if run.faults or run.lifecycle != "armed":
        raise TrialError(f"a fault before the injection: {run.faults}")
    start = run.tick
    first_frame: int | None = None
    restarts = [module.restarts for module in run.backend._reading.modules]

    def inject_then_wave(tick: int) -> SetPoints:
        if tick == start:
            run.backend.inject(injection, begins=True)
        return run.waving(tick)

    while not run.faults and run.tick - start < MOST_TICKS:
        run.run(1, inject_then_wave)
    if not run.faults:
        return Trial(value=None, trouble=f"not found within {MOST_TICKS} periods")
    value = PERIOD_MS * (run.tick - start)  # the safe action goes out where the set-points of this tick would have
    stopped_tick = run.tick
    for _ in range(REST_TICKS):
        run.run(1)
        now = [module.restarts for module in run.backend._reading.modules]
        first_frame = run.tick if first_frame is None and now != restarts else first_frame
    troubles = _objections(run, injection, what)
    if first_frame is not None:
        named = next((f.tick for f in run.faults if f.what == "module_restarted"), None)
        if first_frame < stopped_tick:
            troubles.append("the restarted module was heard before the group was stopped")
        if named is not None:
            request.note(
                f"the group is stopped before the restarted module's first frame; it is named as restarted "
                f"{PERIOD_MS * max(named - first_frame + 1, 0):.0f} ms after that frame, when it cannot be a second "
                f"module with the same id any more"
            )
    back = _back(run, injection, troubles)
    return Trial(value=value, trouble="; ".join(troubles), recovered=back)


def _objections(run: Loop, injection: Injection, what: str) -> list[str]:
    """What is not as it must be after the safe action."""
    troubles: list[str] = []
    if what not in [fault.what for fault in run.faults]:
        troubles.append(f"found as {[fault.what for fault in run.faults]}, not {what}")
    if injection.target_type == "joint" and run.faults[0].joint != injection.target:
        troubles.append(f"{run.faults[0].joint} was named, not {injection.target}: {run.faults[0].cause}")
    if run.true_speed_rad_s[-1] > AT_REST_RAD_S:
        troubles.append(f"still moving at {run.true_speed_rad_s[-1]:.2f} rad/s after {REST_TICKS} periods")
    if run.lifecycle != "fault":
        troubles.append(f"not latched: {run.lifecycle}")
    return troubles


def _back(run: Loop, injection: Injection, troubles: list[str]) -> bool:
    """It ends; somebody clears and arms; the robot moves as before."""
    if not injection.about.once:
        run.backend.inject(injection, begins=False)
    run.run(CLEAR_TICKS)
    run.lifecycle, told = "disarmed", len(run.faults)
    run.run(CLEAR_TICKS)
    if run.lifecycle != "disarmed":  # what had gone wrong meanwhile is told once more after the first clear
        run.lifecycle, told = "disarmed", len(run.faults)
        run.run(CLEAR_TICKS)
    run.wanted = None
    before = np.array(run.samples[-1].joints.angle_rad)
    run.lifecycle = "armed"
    run.run(8)
    if set(run.states()) != {ModuleState.ARMED}:
        troubles.append(f"not armed again: {run.states()}, {run.faults[told:]}")
        return False
    jump = float(np.abs(np.array(run.samples[-1].joints.angle_rad) - before).max())
    if jump > AT_REST_RAD_S:
        troubles.append(f"a joint jumped by {jump:.3f} rad at arming")
    run.run(HARMLESS + 25, run.waving)
    if len(run.faults) > told:
        troubles.append(f"something is wrong again: {run.faults[told:][0]}")
        return False
    moved = max(run.true_speed_rad_s[-20:]) > AT_REST_RAD_S
    run.lifecycle = "disarmed"
    run.run(HARMLESS)
    return moved


def twice_at_start(request: Request) -> Iterator[Trial]:
    """A node id that is there twice when the driver opens. The value: modules that it enabled all the same."""
    for number in range(request.trials):
        joint = f"joint_{number % JOINTS + 1}"
        try:
            with loop(faults=[f"duplicate:{joint}@0"]) as run:
                yield Trial(value=float(run.states().count(ModuleState.ARMED)), trouble="it was opened")
        except BackendError as error:
            trouble = "" if joint in str(error) and "2 times" in str(error) else f"in other words: {error}"
            yield Trial(value=0.0, trouble=trouble)


def through_robot(kind: str, *words: str) -> Measure:
    """A joint's sensor fails while the robot moves. words: names of the fault, any of which will do.

    The value: from the request to the injector to the first safe set-points that were heard of.
    """

    def measure(request: Request) -> Iterator[Trial]:
        rng = random.Random(6)
        with robot(request) as (made, observer):
            for _ in range(request.trials):
                made.set_in_motion(observer)
                joint = f"joint_{rng.randrange(len(observer.description().joints)) + 1}"
                asked_ns = time.monotonic_ns()
                observer.inject("hal", kind, joint, for_s=ASKED_FOR_S)
                value = observer.safe_after_ms(asked_ns)
                status = observer.first_fault(asked_ns)
                troubles: list[str] = []
                if not any(joint in fault.cause or fault.joint == joint for fault in status.faults):
                    troubles.append(f"{joint} was not named: {[fault.cause for fault in status.faults]}")
                if words and not {fault.what for fault in status.faults} & set(words):
                    troubles.append(f"found as {[fault.what for fault in status.faults]}, not {' or '.join(words)}")
                observer.watch(ASKED_FOR_S)
                yield recovered(observer, value, "; ".join(troubles))

    return measure
