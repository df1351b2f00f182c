"""Commands that must not move the robot: from a second controller, out of time, or wrong in themselves."""

import itertools
import random
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from functools import partial

import msgspec

from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import JointCommand, LeaseRequest
from snakesim_testing.hal.authority_rig import ROBOT, make_armed_rig
from snakesim_testing.hal.small_robots import LEASE_NS, PERIOD_NS, make_joint_command
from verification.faults.observer import Observer, TrialError
from verification.faults.robot import robot
from verification.faults.row import InjectionTrial, MeasurementRequest
from verification.faults.stranger import FORGED, CommandForger

EACH = 3  # of every kind in a trial
COUNTED_S = 1.5  # until the status must have counted them
INTERLEAVINGS = 100_000
MOVES = 4  # of two writers in one interleaving

# Name -> how it is sent, and the reason that it is counted by.
Kinds = Mapping[str, tuple[Callable[[], None], str]]


def out_of_time(request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """With the lease's own epoch, so that nothing but their time is wrong."""

    def kinds(stranger: CommandForger) -> Kinds:
        return {
            "stale": (partial(stranger.out_of_time, -20), "stale"),
            "replayed": (partial(stranger.again, 20), "replayed"),
            "reordered": (partial(stranger.again, 2), "replayed"),
            "duplicated": (partial(stranger.again, 1), "replayed"),
            "future": (partial(stranger.out_of_time, 50), "from_the_future"),
            "without an arm session": (stranger.without_arming, "before_arming"),
        }

    yield from _among_good_ones(request, kinds)


def wrong_in_itself(request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """With the lease's own epoch and the right time, so that only what they hold is wrong."""

    def kinds(stranger: CommandForger) -> Kinds:
        return {
            "NaN": (partial(stranger.number, float("nan")), "malformed"),
            "infinity": (partial(stranger.number, float("inf")), "malformed"),
            "out of range (1e9 rad)": (partial(stranger.number, 1e9), "malformed"),
            "wrong length": (stranger.wrong_length, "wrong_length"),
            "wrong joint order": (stranger.wrong_order, "wrong_layout"),
            "malformed": (stranger.malformed, "malformed"),
            "huge (4 MiB and more)": (stranger.huge, "malformed"),
            "unknown version": (stranger.unknown_version, "unknown_version"),
            "another encoding": (stranger.other_message, "unknown_message"),
        }

    yield from _among_good_ones(request, kinds)
    request.note(
        "finite targets beyond a joint's limits are clamped and counted (tests/unit/hal/safety/test_gate_limits.py)"
    )


def _among_good_ones(
    request: MeasurementRequest, make: Callable[[CommandForger], Kinds]
) -> Iterator[InjectionTrial]:
    with robot(request) as (started_robot, observer):
        stranger = CommandForger(observer)
        kinds = make(stranger)
        for _ in range(request.trials):
            started_robot.set_in_motion(observer)
            yield _bombarded(observer, stranger, kinds)
            if started_robot.ended():
                raise AssertionError(f"{started_robot.ended()}: {started_robot.last_words()}")
        each = ", ".join(f"{name}: {reason}" for name, (_, reason) in kinds.items())
        request.note(
            f"in each trial {EACH} of each kind among the controller's own; counted as {each}"
        )


def _bombarded(observer: Observer, stranger: CommandForger, kinds: Kinds) -> InjectionTrial:
    """Send some of each kind among the controller's commands; how many were not refused and counted."""
    before = _counts(observer)
    for _ in range(EACH):
        for name in stranger.random.sample(sorted(kinds), len(kinds)):
            kinds[name][0]()
            time.sleep(stranger.random.random() * PERIOD_NS * 1e-9)
    expected: Counter[str] = Counter()
    for _, reason in kinds.values():
        expected[reason] += EACH

    def uncounted() -> Counter[str]:
        return expected - (_counts(observer) - before)

    return _judged(observer, uncounted, [])


def _judged(
    observer: Observer, uncounted: Callable[[], Counter[str]], failures: list[str]
) -> InjectionTrial:
    """How many setpoints got through; a failure besides `failures` when not all are counted, or the robot stopped."""
    try:
        observer.until(lambda: not uncounted(), "all counted", COUNTED_S)
    except TrialError:
        failures.append(f"not counted: {dict(uncounted())}")
    observer.watch(0.05)
    if observer.state() != "armed":
        failures.append(f"the robot stopped: {observer.in_words()}")
    return InjectionTrial(value=float(applied_of_others(observer)), failure="; ".join(failures))


def _counts(observer: Observer) -> Counter[str]:
    observer.listen()
    return Counter({} if observer.status is None else observer.status.commands_rejected)


def applied_of_others(observer: Observer) -> int:
    """Applied setpoints that were not the controller's own, each newer than the one before."""
    sequences = [h.message.sequence for h in observer.applied]
    forged = sum(s is None or s >= FORGED for s in sequences)
    back = sum(
        1 for a, b in itertools.pairwise(sequences) if a is not None and b is not None and b < a
    )
    return forged + back


def second_controller(request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """A second one asks for the lease, is refused, and commands all the same."""
    with robot(request) as (started_robot, observer):
        stranger, answered_ms = CommandForger(observer), list[float]()
        for _ in range(request.trials):
            started_robot.set_in_motion(observer)
            yield _second(observer, stranger, answered_ms)
        request.note(f"the lease request was answered within {max(answered_ms):.0f} ms")
        request.note(
            "the limiter does not reject a client that reads the epoch from hal/clock and forges the next sequence: "
            "nothing authenticates here, a router's access control does"
        )


def _second(
    observer: Observer, stranger: CommandForger, answered_ms: list[float]
) -> InjectionTrial:
    before = _counts(observer)
    request_start_s = time.monotonic()
    answer = observer.ask(keys.LEASE, LeaseRequest(action="acquire", holder="second"))
    answered_ms.append(1e3 * (time.monotonic() - request_start_s))
    failures: list[str] = []
    if answer.ok or answer.refusal != "lease_held":
        failures.append(f"not refused as held: ok {answer.ok}, {answer.refusal!r}: {answer.reason}")
    epoch = observer.status.lease_epoch if observer.status else 0
    guesses = [0, epoch - 1, epoch + 1, answer.epoch + 2] * EACH
    for guess in guesses:
        stranger.send(stranger.forged(lease_epoch=guess))
        time.sleep(stranger.random.random() * PERIOD_NS * 1e-9)
    expected = Counter(wrong_epoch=len(guesses))
    return _judged(observer, lambda: expected - (_counts(observer) - before), failures)


def interleaved(request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """Two writers at one authority, in an order by chance; the first has the lease and keeps commanding."""
    each = INTERLEAVINGS // request.trials
    for number in range(request.trials):
        writers = TwoWriters(random.Random(number))
        yield InjectionTrial(value=float(sum(writers.interleave() for _ in range(each))))
    request.note(
        f"{each * request.trials} interleavings of {MOVES} moves each, by seed, at the limiter that stands before both "
        f"backends"
    )


OWN, THEIRS = make_joint_command(ROBOT, 0.1), make_joint_command(ROBOT, 0.3)


class TwoWriters:
    """A robot that the first writer has armed. The second asks for the lease, and commands with guessed epochs."""

    def __init__(self, rng: random.Random) -> None:
        self.rng, self.rig, self.theirs = rng, make_armed_rig(), FORGED
        self.authority = self.rig.authority
        self.epoch, self.holder = self.authority.lease.epoch, self.authority.lease.holder

    def interleave(self) -> int:
        """Some moves of both within a lease term; how many setpoints or rights the second one got by them."""
        got = 0
        moves = [
            self.first,
            self.second_commands,
            self.second_asks,
            self.rng.choice((self.second_commands, self.ends)),
        ]
        for move in self.rng.sample(moves, MOVES):
            self.rig.now_ns += self.rng.randrange(PERIOD_NS // 2)
            got += move()
        decision = self.authority.compute_setpoints()
        self.authority.latch_faults_and_expire_lease(self.rig.now_ns, self.rig.tick)
        stopped = self.authority.state != "armed"
        return (
            got
            + (decision.command_sequence is not None and decision.command_sequence >= FORGED)
            + stopped
        )

    def first(self) -> bool:
        """The first commands, with its own epoch."""
        self.rig.sequence += 1
        assert self._offer(OWN, self.rig.sequence, self.epoch) is None
        return False

    def second_commands(self) -> bool:
        """The second commands, with an epoch that is not the first one's."""
        self.theirs += 1
        guess = self.rng.choice(
            (0, self.epoch - 1, self.epoch + 1, self.epoch + self.rng.randrange(1, 2**40))
        )
        return self._offer(THEIRS, self.theirs, guess) is None

    def second_asks(self) -> bool:
        """The second wants the lease, at no higher priority."""
        lease_request = LeaseRequest(
            action=self.rng.choice(("acquire", "renew", "release")),
            holder="second",
            epoch=self.epoch,
            priority=self.rng.randrange(101),
        )
        answer = self.authority.handle_lease_request(lease_request, self.rig.now_ns)
        return answer.ok or self.authority.lease.holder != self.holder

    def ends(self) -> bool:
        """A tick ends."""
        self.rig.tick += 1
        self.rig.observe(0.1)
        return False

    def _offer(self, command: JointCommand, sequence: int, epoch: int) -> str | None:
        tick, now_ns, arm_session = self.rig.tick, self.rig.now_ns, self.authority.arm_session
        started_robot = msgspec.structs.replace(
            command, sequence=sequence, tick=tick, lease_epoch=epoch, arm_session=arm_session
        )
        return self.authority.process_command(
            started_robot, now_ns=now_ns, tick=tick, age_ns=self.rng.randrange(LEASE_NS)
        )
