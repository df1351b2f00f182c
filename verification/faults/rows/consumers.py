"""Measures consumers of the robot's streams that cannot keep up. Only they may be affected.

A control cycle counts as missed if the setpoints of a tick answer the same command as those of the tick before.
"""

import itertools
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial

import msgspec

from snakesim_testing.harness.wait import wait_until
from verification.attack.tools.floods import run_flooders
from verification.faults.observer import Observer
from verification.faults.robot import ProcessRobot, start_robot
from verification.faults.row import InjectionTrial, MeasurementRequest
from verification.faults.slow_consumer import STUCK

WINDOW_S = 0.5
FROZEN_READERS = 4
FROZEN_WINDOW_S = 1.0  # 20 such windows take longer than Zenoh's lease of a link
FROZEN_RATE_HZ = {"sim": 200.0, "can": 100.0}  # what one bus carries
WINDOWS_WITHOUT_READERS = 5
STUCK_TIMEOUT_S = 20.0


def _measure_slow_consumer(kind: str, request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """Start a consumer that cannot keep up.

    Args:
        kind: `sleep` for a callback that sleeps, `disk` for a full disk.
        request: Measurement to make.

    Yields:
        A trial for each window. Its value is how many more cycles were missed than in the worst window before the
        consumer started.
    """
    with start_robot(request) as (robot, observer):
        missed_before = [_count_missed_cycles(observer, WINDOW_S) for _ in range(request.trials)]
        missed_with_consumer: list[int] = []
        with _start_consumer(kind, robot) as process:
            for _ in range(request.trials):
                missed = _count_missed_cycles(observer, WINDOW_S)
                missed_with_consumer.append(missed)
                trial = _make_window_trial(observer, missed - max(missed_before))
                if process.poll() is not None and not trial.failure:
                    trial = msgspec.structs.replace(trial, failure="the consumer has ended")
                yield trial
        request.add_note(
            f"in {request.trials} windows of {WINDOW_S:g} s: {sum(missed_before)} cycles missed without the consumer, "
            f"worst {max(missed_before)}; {sum(missed_with_consumer)} with it, worst {max(missed_with_consumer)}"
        )


measure_sleeping_consumer = partial(_measure_slow_consumer, "sleep")
measure_consumer_with_full_disk = partial(_measure_slow_consumer, "disk")


def measure_frozen_readers(request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """Freeze the processes of readers that subscribe to every key.

    Their buffers are small and full at once, so a process that waits for them would stop.

    Yields:
        A trial for each window. Its value is how many more cycles were missed than in the worst window before the
        readers started.
    """
    rate_hz = FROZEN_RATE_HZ[request.backend]
    with (
        start_robot(request, rate_hz=rate_hz, controller="hold") as (robot, observer),
        ExitStack() as stack,
    ):
        missed_before = [
            _count_missed_cycles(observer, FROZEN_WINDOW_S) for _ in range(WINDOWS_WITHOUT_READERS)
        ]
        readers = stack.enter_context(
            run_flooders(request.folder, "everything", robot.endpoint, 0, FROZEN_READERS)
        )
        for reader in readers:
            stack.callback(reader.send_signal, signal.SIGCONT)
            reader.send_signal(signal.SIGSTOP)
        if observer.get_lifecycle() != "armed":
            observer.arm()
        missed_with_readers: list[int] = []
        for _ in range(request.trials):
            missed = _count_missed_cycles(observer, FROZEN_WINDOW_S)
            missed_with_readers.append(missed)
            yield _make_window_trial(observer, missed - max(missed_before))
        request.add_note(
            f"{FROZEN_READERS} readers at {rate_hz:g} Hz for {request.trials * FROZEN_WINDOW_S:g} s: "
            f"{sum(missed_before)} cycles missed in {len(missed_before)} windows of {FROZEN_WINDOW_S:g} s without "
            f"them, {sum(missed_with_readers)} in {request.trials} with them, worst {max(missed_with_readers)}"
        )


def _make_window_trial(observer: Observer, more_missed: int) -> InjectionTrial:
    """Return the trial of a window. A robot that stopped is armed again."""
    failure = ""
    if observer.get_lifecycle() != "armed":
        failure = f"the robot stopped: {observer.describe_status()}"
        observer.arm()
    return InjectionTrial(value=float(max(more_missed, 0)), failure=failure)


def _count_missed_cycles(observer: Observer, window_s: float) -> int:
    """Observe a window, and return how many control cycles were missed in it."""
    observer.forget()
    observer.listen_for(window_s)
    sequences = [received.message.sequence for received in observer.applied]
    return sum(
        sequence is not None and sequence == previous
        for previous, sequence in itertools.pairwise(sequences)
    )


@contextmanager
def _start_consumer(kind: str, robot: ProcessRobot) -> Iterator[subprocess.Popen[str]]:
    """Start a consumer, and yield its process as soon as it cannot keep up."""
    command = [sys.executable, "-m", "verification.faults.slow_consumer"]
    command += [kind, robot.endpoint, robot.config.robot.name]
    log = robot.folder / "consumer.log"
    with log.open("w") as output:
        process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT, text=True)
    try:
        wait_until(
            lambda: STUCK in log.read_text() or process.poll() is not None,
            "the consumer is stuck",
            STUCK_TIMEOUT_S,
        )
        assert process.poll() is None, f"the consumer did not get stuck: {log.read_text()[-500:]}"
        yield process
    finally:
        process.kill()
        process.wait()
