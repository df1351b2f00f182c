"""Measures commands that must not move the robot: of a second controller, at a wrong time, or with invalid content."""

import itertools
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial

from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import LeaseRequest
from snakesim_testing.hal.small_robots import PERIOD_NS
from verification.faults.command_forger import MIN_FORGED_SEQUENCE, CommandForger
from verification.faults.observer import Observer, TrialError
from verification.faults.robot import start_robot
from verification.faults.row import InjectionTrial, MeasurementRequest

REPETITIONS = 3  # of every kind of command in a trial
COUNTING_TIMEOUT_S = 1.5  # until the status has counted the rejected commands
SETTLED_S = 0.05  # after that, in which another setpoint may still arrive


# --- commands at the wrong time or with invalid content, among those of the controller ------------------------------


@dataclass(frozen=True)
class ForgedKind:
    """A kind of forged command."""

    send: Callable[[], None]
    rejection_reason: str  # by which the host counts it


ForgedKinds = Mapping[str, ForgedKind]
"""Kinds of forged commands by the name that the note of a row gives them."""


def measure_out_of_time(request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """Send commands with the right lease epoch at the wrong time, or again.

    Yields:
        Trials whose value is the number of applied setpoints that were not the controller's own.
    """

    def make_kinds(forger: CommandForger) -> ForgedKinds:
        return {
            "stale": ForgedKind(partial(forger.send_at_wrong_tick, -20), "stale"),
            "replayed": ForgedKind(partial(forger.replay_command, 20), "replayed"),
            "reordered": ForgedKind(partial(forger.replay_command, 2), "replayed"),
            "duplicated": ForgedKind(partial(forger.replay_command, 1), "replayed"),
            "future": ForgedKind(partial(forger.send_at_wrong_tick, 50), "from_the_future"),
            "without an arm session": ForgedKind(forger.send_without_arm_session, "before_arming"),
        }

    yield from _measure_forged_kinds(request, make_kinds)


def measure_invalid_content(request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """Send commands with the right lease epoch, sequence number and tick, but with invalid content.

    Yields:
        Trials whose value is the number of applied setpoints that were not the controller's own.
    """

    def make_kinds(forger: CommandForger) -> ForgedKinds:
        return {
            "NaN": ForgedKind(partial(forger.send_target, float("nan")), "malformed"),
            "infinity": ForgedKind(partial(forger.send_target, float("inf")), "malformed"),
            "out of range (1e9 rad)": ForgedKind(partial(forger.send_target, 1e9), "malformed"),
            "wrong length": ForgedKind(forger.send_wrong_length, "wrong_length"),
            "wrong joint order": ForgedKind(forger.send_wrong_joint_order, "wrong_layout"),
            "malformed": ForgedKind(forger.send_malformed_bytes, "malformed"),
            "huge (4 MiB and more)": ForgedKind(forger.send_huge_payload, "malformed"),
            "unknown version": ForgedKind(forger.send_unknown_version, "unknown_version"),
            "another encoding": ForgedKind(forger.send_other_encoding, "unknown_message"),
        }

    yield from _measure_forged_kinds(request, make_kinds)
    request.add_note(
        "finite targets beyond a joint's limits are clamped and counted (tests/unit/hal/safety/test_gate_limits.py)"
    )


def _measure_forged_kinds(
    request: MeasurementRequest, make_kinds: Callable[[CommandForger], ForgedKinds]
) -> Iterator[InjectionTrial]:
    """Send every kind of forged command while the controller moves the robot."""
    with start_robot(request) as (robot, observer):
        forger = CommandForger(observer)
        kinds = make_kinds(forger)
        for _ in range(request.trials):
            robot.set_in_motion(observer)
            yield _run_forging_trial(observer, forger, kinds)
            exits = robot.describe_exits()
            if exits:
                raise AssertionError(f"{exits}: {robot.read_last_output()}")
        reasons = ", ".join(f"{name}: {kind.rejection_reason}" for name, kind in kinds.items())
        request.add_note(
            f"in each trial {REPETITIONS} of each kind among the controller's own; counted as {reasons}"
        )


def _run_forging_trial(
    observer: Observer, forger: CommandForger, kinds: ForgedKinds
) -> InjectionTrial:
    """Send REPETITIONS commands of each kind in random order, at random times."""
    counts_before = _read_rejections(observer)
    for _ in range(REPETITIONS):
        for name in forger.random.sample(sorted(kinds), len(kinds)):
            kinds[name].send()
            _sleep_at_most_a_period(forger)
    expected: Counter[str] = Counter()
    for kind in kinds.values():
        expected[kind.rejection_reason] += REPETITIONS
    return _judge_forging_trial(observer, expected, counts_before, [])


def _judge_forging_trial(
    observer: Observer,
    expected: Counter[str],
    counts_before: Counter[str],
    failures: list[str],
) -> InjectionTrial:
    """Return the trial after all forged commands were sent.

    Args:
        observer: Observer of the robot.
        expected: How many commands the host must have rejected in the trial, by reason.
        counts_before: How many it had rejected before.
        failures: What was wrong in the trial so far.
    """

    def count_missing() -> Counter[str]:
        return expected - (_read_rejections(observer) - counts_before)

    try:
        observer.wait_until(lambda: not count_missing(), "all counted", COUNTING_TIMEOUT_S)
    except TrialError:
        failures.append(f"not counted: {dict(count_missing())}")
    observer.listen_for(SETTLED_S)
    if observer.get_lifecycle() != "armed":
        failures.append(f"the robot stopped: {observer.describe_status()}")
    foreign_count = _count_foreign_setpoints(observer)
    return InjectionTrial(value=float(foreign_count), failure="; ".join(failures))


def _read_rejections(observer: Observer) -> Counter[str]:
    """Return how many commands the host has rejected so far, by reason."""
    observer.listen()
    if observer.status is None:
        return Counter()
    return Counter(observer.status.commands_rejected)


def _count_foreign_setpoints(observer: Observer) -> int:
    """Return how many applied setpoints did not come from the controller, or came from an older command."""
    sequences = [received.message.sequence for received in observer.applied]
    foreign_count = sum(
        sequence is None or sequence >= MIN_FORGED_SEQUENCE for sequence in sequences
    )
    older_count = sum(
        previous is not None and sequence is not None and sequence < previous
        for previous, sequence in itertools.pairwise(sequences)
    )
    return foreign_count + older_count


def _sleep_at_most_a_period(forger: CommandForger) -> None:
    """Sleep until a random phase of a control period."""
    time.sleep(forger.random.random() * PERIOD_NS * 1e-9)


# --- a second controller on the network ----------------------------------------------------------------------------


def measure_second_controller(request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """Request the lease for a second controller, and send its commands although the lease is refused.

    Yields:
        Trials whose value is the number of applied setpoints that were not the first controller's.
    """
    with start_robot(request) as (robot, observer):
        forger = CommandForger(observer)
        answer_times_ms: list[float] = []
        for _ in range(request.trials):
            robot.set_in_motion(observer)
            yield _run_second_controller_trial(observer, forger, answer_times_ms)
        request.add_note(f"the lease request was answered within {max(answer_times_ms):.0f} ms")
        request.add_note(
            "the limiter does not reject a client that reads the epoch from hal/clock and forges the next sequence: "
            "nothing authenticates here, a router's access control does"
        )


def _run_second_controller_trial(
    observer: Observer, forger: CommandForger, answer_times_ms: list[float]
) -> InjectionTrial:
    """Request the lease once, send commands with guessed epochs, and add the time of the answer to a list."""
    counts_before = _read_rejections(observer)
    start_s = time.monotonic()
    answer = observer.send_request(keys.LEASE, LeaseRequest(action="acquire", holder="second"))
    answer_times_ms.append(1e3 * (time.monotonic() - start_s))
    failures: list[str] = []
    if answer.ok or answer.refusal != "lease_held":
        failures.append(f"not refused as held: ok {answer.ok}, {answer.refusal!r}: {answer.reason}")
    epoch = observer.status.lease_epoch if observer.status else 0
    guessed_epochs = [0, epoch - 1, epoch + 1, answer.epoch + 2] * REPETITIONS
    for guessed_epoch in guessed_epochs:
        forger.send_command(forger.make_command(lease_epoch=guessed_epoch))
        _sleep_at_most_a_period(forger)
    expected = Counter(wrong_epoch=len(guessed_epochs))
    return _judge_forging_trial(observer, expected, counts_before, failures)
