"""Measures two writers of commands that use one command authority in random order.

Everything runs in this process, with simulated time: the row needs many interleavings, but no robot.
"""

import random
from collections.abc import Iterator

import msgspec

from snakesim_hal.wire.messages import JointCommand, LeaseRequest
from snakesim_testing.hal.authority_rig import ROBOT, make_armed_rig
from snakesim_testing.hal.small_robots import LEASE_NS, PERIOD_NS, make_joint_command
from verification.faults.command_forger import MIN_FORGED_SEQUENCE
from verification.faults.row import InjectionTrial, MeasurementRequest

INTERLEAVINGS = 100_000  # of all trials together
MOVES = 4  # of both writers in one interleaving
FIRST_COMMAND = make_joint_command(ROBOT, 0.1)
SECOND_COMMAND = make_joint_command(ROBOT, 0.3)


def measure_interleaved_writers(request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """Let two writers use one command authority. The first one holds the lease and sends commands.

    Yields:
        Trials whose value is the number of setpoints and rights that the second writer obtained.
    """
    trial_size = INTERLEAVINGS // request.trials
    for seed in range(request.trials):
        writers = TwoWriters(random.Random(seed))
        success_count = sum(writers.interleave() for _ in range(trial_size))
        yield InjectionTrial(value=float(success_count))
    request.add_note(
        f"{trial_size * request.trials} interleavings of {MOVES} moves each, by seed, at the command authority that "
        "both backends share"
    )


class TwoWriters:
    """A robot that the first writer has armed. The second writer requests the lease, and guesses epochs.

    Each move returns whether the second writer obtained a right or was accepted.
    """

    def __init__(self, rng: random.Random) -> None:
        self._rng = rng
        self._rig = make_armed_rig()
        self._authority = self._rig.authority
        self._first_epoch = self._authority.lease.epoch
        self._first_holder = self._authority.lease.holder
        self._second_sequence = MIN_FORGED_SEQUENCE

    def interleave(self) -> int:
        """Make MOVES moves in random order within a lease term, and end the control cycle.

        Returns:
            How many setpoints and rights the second writer obtained, and whether the robot stopped.
        """
        moves = [
            self._send_first_command,
            self._send_second_command,
            self._request_lease_for_second,
            self._rng.choice((self._send_second_command, self._end_tick)),
        ]
        success_count = 0
        for move in self._rng.sample(moves, MOVES):
            self._rig.now_ns += self._rng.randrange(PERIOD_NS // 2)
            success_count += move()
        sequence = self._authority.compute_setpoints().command_sequence
        if sequence is not None and sequence >= MIN_FORGED_SEQUENCE:
            success_count += 1
        self._authority.latch_faults_and_expire_lease(self._rig.now_ns, self._rig.tick)
        if self._authority.state != "armed":
            success_count += 1
        return success_count

    def _send_first_command(self) -> bool:
        """Send a command of the first writer, with its own epoch. The authority must accept it."""
        self._rig.sequence += 1
        rejection = self._process_command(FIRST_COMMAND, self._rig.sequence, self._first_epoch)
        assert rejection is None
        return False

    def _send_second_command(self) -> bool:
        """Send a command of the second writer, with a guessed epoch."""
        self._second_sequence += 1
        epoch = self._first_epoch
        guessed_epoch = self._rng.choice(
            (0, epoch - 1, epoch + 1, epoch + self._rng.randrange(1, 2**40))
        )
        rejection = self._process_command(SECOND_COMMAND, self._second_sequence, guessed_epoch)
        return rejection is None

    def _request_lease_for_second(self) -> bool:
        """Request, renew or release the lease as the second writer, with a priority that is not higher."""
        request = LeaseRequest(
            action=self._rng.choice(("acquire", "renew", "release")),
            holder="second",
            epoch=self._first_epoch,
            priority=self._rng.randrange(101),
        )
        answer = self._authority.handle_lease_request(request, self._rig.now_ns)
        return answer.ok or self._authority.lease.holder != self._first_holder

    def _end_tick(self) -> bool:
        self._rig.tick += 1
        self._rig.observe(0.1)
        return False

    def _process_command(self, command: JointCommand, sequence: int, epoch: int) -> str | None:
        """Pass a command of a random age to the authority. Return the reason of its rejection."""
        tick = self._rig.tick
        complete_command = msgspec.structs.replace(
            command,
            sequence=sequence,
            tick=tick,
            lease_epoch=epoch,
            arm_session=self._authority.arm_session,
        )
        return self._authority.process_command(
            complete_command,
            now_ns=self._rig.now_ns,
            tick=tick,
            age_ns=self._rng.randrange(LEASE_NS),
        )
