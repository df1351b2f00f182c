"""Somebody else listens, and cannot keep up: only he may suffer."""

import itertools
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path

import msgspec

from snakesim_testing.harness.wait import wait_until
from verification.attack.tools.floods import run_flooders
from verification.faults.consumer import STUCK
from verification.faults.observer import Observer
from verification.faults.robot import robot
from verification.faults.row import InjectionTrial, MeasurementRequest

WINDOW_S = 0.5
FROZEN, FROZEN_WINDOW_S = 4, 1.0  # 20 such windows outlast Zenoh's lease of a link
FROZEN_HZ = {"sim": 200.0, "can": 100.0}  # what one bus carries


def cannot_keep_up(kind: str, request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """kind: `sleep` in the callback, or `disk` that is full.

    A cycle is missed when the setpoints of a tick are those of the tick before: no command had come for it. The value:
    how many more are missed in half a second than in the worst such window before the consumer came.
    """
    with robot(request) as (started_robot, observer):
        before, with_it = [_missed(observer) for _ in range(request.trials)], list[int]()
        with _consumer(
            kind, started_robot.endpoint, started_robot.config.robot.name, request.folder
        ) as process:
            for _ in range(request.trials):
                with_it.append(_missed(observer))
                trial = _beside_it(observer, with_it[-1] - max(before))
                ended = process.poll() is not None and not trial.failure
                yield (
                    msgspec.structs.replace(trial, failure="the consumer has ended")
                    if ended
                    else trial
                )
        request.note(
            f"in {request.trials} windows of {WINDOW_S:g} s: {sum(before)} cycles missed without the consumer, "
            f"worst {max(before)}; {sum(with_it)} with it, worst {max(with_it)}"
        )


sleeps, disk_full = (partial(cannot_keep_up, kind) for kind in ("sleep", "disk"))


def frozen_readers(request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """Readers of everything whose processes are stopped, and stay. The value: as above, in windows of a second.

    Their buffers are small and full at once, so a process that waits for them stops.
    """
    rate_hz = FROZEN_HZ[request.backend]
    with (
        robot(request, rate_hz=rate_hz, controller="hold") as (started_robot, observer),
        ExitStack() as stack,
    ):
        before, with_them = [_missed(observer, FROZEN_WINDOW_S) for _ in range(5)], list[int]()
        for reader in stack.enter_context(
            run_flooders(request.folder, "everything", started_robot.endpoint, 0, FROZEN)
        ):
            stack.callback(reader.send_signal, signal.SIGCONT)
            reader.send_signal(signal.SIGSTOP)
        if observer.state() != "armed":
            observer.arm()
        for _ in range(request.trials):
            with_them.append(_missed(observer, FROZEN_WINDOW_S))
            yield _beside_it(observer, with_them[-1] - max(before))
        request.note(
            f"{FROZEN} readers at {rate_hz:g} Hz for {request.trials * FROZEN_WINDOW_S:g} s: {sum(before)} cycles "
            f"missed in {len(before)} windows of {FROZEN_WINDOW_S:g} s without them, {sum(with_them)} in "
            f"{request.trials} with them, worst {max(with_them)}"
        )


def _beside_it(observer: Observer, more_missed: int) -> InjectionTrial:
    """Of a window; a robot that has stopped in it is armed again."""
    failure = ""
    if observer.state() != "armed":
        failure = f"the robot stopped: {observer.in_words()}"
        observer.arm()
    return InjectionTrial(value=float(max(more_missed, 0)), failure=failure)


def _missed(observer: Observer, window_s: float = WINDOW_S) -> int:
    observer.forget()
    observer.watch(window_s)
    rows = [received.message for received in observer.applied]
    return sum(
        a.sequence == b.sequence for a, b in itertools.pairwise(rows) if b.sequence is not None
    )


@contextmanager
def _consumer(
    kind: str, endpoint: str, namespace: str, folder: Path
) -> Iterator[subprocess.Popen[str]]:
    """As soon as it is stuck."""
    command = [sys.executable, "-m", "verification.faults.consumer", kind, endpoint, namespace]
    log = folder / "consumer.log"
    with log.open("w") as output:
        process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT, text=True)
    try:
        wait_until(
            lambda: STUCK in log.read_text() or process.poll() is not None,
            "the consumer is stuck",
            20.0,
        )
        assert process.poll() is None, f"the consumer did not get stuck: {log.read_text()[-500:]}"
        yield process
    finally:
        process.kill()
        process.wait()
