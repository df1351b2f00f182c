"""The simulator is slow, or its numbers blow up."""

import math
from collections.abc import Iterator

import msgspec
import numpy as np

from snakesim_hal.run_log.black_box import read_black_box
from snakesim_hal.run_log.host_record import BLACK_BOX, HOST_RECORD, HostRecord
from verification.faults.observer import TrialError
from verification.faults.robot import START_LIMIT_S, recovered, robot
from verification.faults.row import InjectionTrial, MeasurementRequest

SHARE = 0.1  # of real time
WINDOW_TICKS = 15
MAX_STEP_RAD = 0.2  # of a joint within one period; a diverged one is further off


def slow(request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """Lockstep at a tenth of real time. The value: stops and faults in a window of it."""
    with robot(request, clock_mode="lockstep") as (_, observer):
        observer.inject("hal", "slow", "simulator", amount=SHARE)
        period_s, shares = observer.description().period_ns * 1e-9, list[float]()
        for _ in range(request.trials):
            observer.forget()
            observer.until(
                lambda: len(observer.clocks) > WINDOW_TICKS or observer.state() != "armed",
                "ticks",
                30.0,
            )
            status = observer.status
            faults = len(status.faults) if status is not None else 0
            stops = sum(h.message.sequence is None for h in observer.applied)
            if len(observer.clocks) > 2:
                took_s = (observer.clocks[-1].at_ns - observer.clocks[1].at_ns) * 1e-9
                shares.append((len(observer.clocks) - 2) * period_s / took_s)
            failure = "" if observer.state() == "armed" else f"stopped: {observer.in_words()}"
            if shares and shares[-1] > 2 * SHARE:
                failure = failure or f"the simulator was not slow: {shares[-1]:.2f} of real time"
            yield InjectionTrial(value=float(faults + stops), failure=failure)
        observer.inject("hal", "slow", "simulator", end=True)
        request.note(
            f"{WINDOW_TICKS} ticks each, at {min(shares):.3f} to {max(shares):.3f} of real time"
        )


def diverges(request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """Its state becomes impossible. The value: steps from the injection to the fault. Then a new host is started."""
    with robot(request) as (started_robot, observer):
        for _ in range(request.trials):
            started_robot.set_in_motion(observer)
            record = request.folder / HOST_RECORD
            record.unlink(missing_ok=True)
            observer.inject("hal", "diverge", "simulator")
            started_robot.running["host"].process.wait(START_LIMIT_S)
            observer.listen()
            left = msgspec.json.decode(record.read_bytes(), type=HostRecord)
            _, box = read_black_box(request.folder / BLACK_BOX)
            failures: list[str] = []
            fault = next((f for f in left.faults if "diverged" in f.cause), None)
            if fault is None:
                raise TrialError(f"no divergence among {left.faults}")
            if left.lifecycle != "fault":
                failures.append(f"the host ended {left.lifecycle}")
            angles = box["angle_rad"]
            if not np.isfinite(angles).all():
                failures.append("a state that is no number was recorded")
            last = [h for _, h in sorted(observer.joints.items())][-1]
            if not all(map(math.isfinite, last.angle_rad)):
                failures.append("a state that is no number was published")
            elif np.abs(np.array(last.angle_rad) - angles[-1]).max() > MAX_STEP_RAD:
                failures.append("the last state that was published is not the last good one")
            observer.forget()
            started_robot.start("host")
            observer.until(lambda: observer.statuses, "a status of the new host", START_LIMIT_S)
            # `tick 31: diverge:simulator@...`.
            reported = next(text for text in left.injected if "diverge" in text)
            begun = int(reported.removeprefix("tick ").partition(":")[0])
            yield recovered(observer, float(fault.tick - begun + 1), "; ".join(failures))
        request.note(
            "the host process ends after a divergence, with its record; a new one was started and armed"
        )
