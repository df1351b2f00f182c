"""Drives on one CAN bus: a `snakesim_drivers.kit.drive_backend.Drives` without its protocol, which a driver type adds.

Each tick every drive is asked for motion and torque, and one of them for its health.
"""

import struct
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Sequence

from snakesim_can_backend.bus.bus import VirtualPeer, Wire, inject_into, receive_frames, wait
from snakesim_can_backend.bus.bus_errors import BUS_FAULTS
from snakesim_can_backend.protocol.definitions import Frame
from snakesim_drivers.emulation.emulated_body import FAULTS
from snakesim_drivers.kit.findings import Finding
from snakesim_drivers.kit.following import Following, Word
from snakesim_drivers.kit.readings import Readings
from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import BackendError
from snakesim_hal.model.fault_kinds import Injection
from snakesim_hal.model.joints import Joint
from snakesim_hal.wire.messages import Mode

ASK_EVERY_S = 0.1  # in bring-up
LISTEN_ON_S = 0.06  # after the last drive has answered: a second one with its id may answer later
STRANGER_FRAMES = 3
HOST = -1  # sender of a frame that only a host sends


class CanDrives(ABC):
    """All drives of a bus, tail to head. What a driver type adds are the abstract methods, and `unheard`."""

    unheard: str  # why a drive may not say who it is

    def __init__(
        self,
        joints: Sequence[Joint],
        wire: Wire,
        readings: Readings,
        *,
        emulator: VirtualPeer | None,
        emulated: bool,
        answer_s: float,
        bring_up_s: float,
        says_every_ns: int,
        clock_ns: Callable[[], int],
    ) -> None:
        """emulator: the drives, if they are emulated here.

        answer_s: how long a tick waits for answers; says_every_ns: how often a drive reports its state.
        """
        self.emulated, self._emulator = emulated, emulator
        self.wire, self.nodes = wire, [joint.id for joint in joints]
        self.readings, self.clock_ns = readings, clock_ns
        who = [f"{j.name} (node {j.id} on {wire.channel})" for j in joints]
        self.following = Following(who, says_every_ns, clock_ns)
        self.firmware: list[tuple[int, ...]] = [()] * len(joints)  # as drives say in bring-up
        self._serials: list[list[str]] = [[] for _ in joints]  # that answer by a joint's id; the first is its own
        self._at = {node: i for i, node in enumerate(self.nodes)}
        self._answer_s, self._bring_up_s = answer_s, bring_up_s
        self._turn = 0  # whose health is asked for next
        self._strangers: Counter[int] = Counter()
        self._others = False  # whether somebody else commands drives
        self._ours = False

    # --- what a driver type adds; i: a joint, tail to head ----------------------------------------------------------

    @abstractmethod
    def sender(self, frame: Frame) -> int | None:
        """The node whose message it is; `HOST` if only a host sends it; None for what does not matter."""

    @abstractmethod
    def hear(self, i: int, frame: Frame) -> None:
        """A message of a drive, into `readings`, `following` and `firmware`.

        ValueError, LookupError, struct.error: it is malformed.
        """

    @abstractmethod
    def identify(self, i: int) -> None:
        """Ask for firmware and state."""

    def identified(self, i: int) -> bool:
        """Whether a drive has said all that the bring-up asks it for."""
        return bool(self.firmware[i])

    def begin_anew(self) -> None:
        """Forget what drives said before, as a bring-up begins."""
        self.firmware = [()] * len(self.nodes)
        self._serials = [[] for _ in self.nodes]

    @abstractmethod
    def give_back(self, i: int) -> None:
        """At the end: write back settings of a drive that this driver has changed, and that the next one reads."""

    @abstractmethod
    def unfit(self, i: int) -> str:
        """Why a drive that said its firmware cannot be used; empty if it can."""

    @abstractmethod
    def ask(self, i: int) -> bool:
        """Ask for motion and torque; whether the bus took the question."""

    @abstractmethod
    def ask_health(self, i: int) -> None:
        """Ask for supply, heat and errors."""

    @abstractmethod
    def setpoint(self, i: int, mode: Mode, target: float, limit_nm: float) -> None:
        """A setpoint, at the shaft."""

    @abstractmethod
    def tell(self, i: int, word: Word) -> None:
        """Follow, be idle, or stop."""

    @abstractmethod
    def set_up(self, i: int) -> None:
        """Write what is not in a drive's memory after a restart."""

    @abstractmethod
    def forgive(self, i: int) -> None:
        """At the start: clear what a driver that was killed has left, and nothing else."""

    @abstractmethod
    def clear_errors(self, i: int) -> None:
        """Clear all errors, for the operator."""

    # --- Drives ------------------------------------------------------------------------------------------------

    def bring_up(self) -> None:
        """Firmware, then settings; every drive is idle, and stays so."""
        everybody = range(len(self.nodes))
        self.begin_anew()
        self._await(self.identified, self.identify)
        self._listen_on()
        wrong = [f"  {self.following.drives[i].who} {why}" for i in everybody for why in self._objections(i)]
        if self._others:
            raise BackendError("another program commands drives on this bus; end it first. Nothing was sent")
        if wrong:
            raise BackendError("the robot is not complete; nothing was enabled:", *wrong)
        self._ours = True
        for i in everybody:
            self.tell(i, "idle")
            self.forgive(i)
            self.set_up(i)
        self._await(self.readings.known, self.ask)
        silent = [self.following.drives[i].who for i in everybody if not self.readings.known(i)]
        if silent:
            raise BackendError(f"{', '.join(silent)}: no motion and torque; nothing was enabled")
        for i in everybody:
            self.ask_health(i)
        self._receive()
        self._strangers.clear()

    def _objections(self, i: int) -> Iterator[str]:
        """Why the robot cannot be used with what answers by the id of a joint."""
        if not self.firmware[i]:
            yield self.unheard
        elif why := self.unfit(i):
            yield why
        if len(self._serials[i]) > 1:
            yield f"answers with {len(self._serials[i])} serial numbers, {self._both(i)}: give each drive its own id"

    def _both(self, i: int) -> str:
        return " and ".join(self._serials[i])

    def note_serial(self, i: int, serial: str) -> None:
        """Remember a serial number that answers by the id of a joint: two are two drives with one id."""
        if serial not in self._serials[i]:
            self._serials[i].append(serial)
        self.readings.identified(i, serial=self._serials[i][0])

    def read(self) -> None:
        """Ask, and wait for those who answered lately."""
        self._receive()
        for i in range(len(self.nodes)):
            if not self.ask(i):
                self.readings.not_asked(i)
        self._turn = (self._turn + 1) % len(self.nodes)
        self.ask_health(self._turn)
        end = time.monotonic() + self._answer_s
        while self.readings.incomplete() and (left_s := end - time.monotonic()) > 0:
            if not wait([self.wire], left_s):
                break
            self._receive()

    def let_run(self) -> None:
        """Receive."""
        wait([self.wire], 0.0)
        self._receive()

    def command(
        self,
        following: frozenset[int],
        modes: list[Mode],
        targets: Floats,
        limits_nm: Floats,
        *,
        may_enable: bool,
        emergency: bool,
    ) -> None:
        """Setpoints; enable, let go, remind."""
        if not may_enable:
            following &= self.following.enabled()
        for i in sorted(following):
            self.setpoint(i, modes[i], float(targets[i]), float(limits_nm[i]))
        for i, word in self.following.words(following, emergency=emergency):
            self.tell(i, word)

    def clear(self, joints: frozenset[int]) -> None:
        """Errors, and what a restart has lost; what a drive says of errors from now on is of after the clear."""
        self.following.forgive(joints)
        self._serials = [serials[:1] for serials in self._serials]  # whether a second drive is still there
        for i in sorted(joints):
            self.clear_errors(i)
            self.set_up(i)

    def inject(self, injection: Injection, *, begins: bool) -> bool:
        """Faults of the bus, and of drives that are emulated here."""
        if inject_into([self.wire], injection, begins=begins):
            return True
        if self._emulator is None or injection.kind not in FAULTS:
            return False
        self._emulator.inject(injection, begins=begins)
        return True

    def close(self) -> None:
        """Idle, as far as the bus still works."""
        for i in range(len(self.nodes)) if self._ours else ():
            try:
                self.tell(i, "idle")
                self.give_back(i)
            except BackendError:
                continue
        try:
            self.wire.idle()
        finally:
            self.wire.close()

    def findings(self) -> list[Finding]:
        """Of bus, strangers and drives."""
        found = [
            Finding(error.kind, f"{error.channel}: {error.detail}; {BUS_FAULTS[error.kind]}")
            for error in self.wire.errors()
            if error.kind in BUS_FAULTS
        ]
        if self._others:
            found.append(Finding("second_host", "another program commands drives on this bus; end one of the two"))
            self._others = False
        for node, frames in self._strangers.items():
            if frames >= STRANGER_FRAMES:
                found.append(Finding("unknown_node", f"node {node} is on the bus, but is not a joint of this robot"))
        for i, serials in enumerate(self._serials):
            if len(serials) > 1:  # it concerns all: nothing is known of where which of the two is
                cause = f"{self.following.drives[i].who} is duplicated: serial numbers {self._both(i)} answer; "
                found.append(Finding("duplicate_node", cause + "give each drive its own id", i))
        return [*found, *self.following.findings()]

    def take(self, frame: Frame) -> None:
        """One frame of the bus."""
        node = self.sender(frame)
        i = self._at.get(-1 if node is None else node)
        if i is not None:
            try:
                self.hear(i, frame)
            except (ValueError, LookupError, struct.error):
                return
        elif node == HOST:
            self._others = True
        elif node is not None:
            self._strangers[node] += 1

    def _receive(self) -> None:
        for frame in self.wire.receive():
            self.take(frame)

    def _listen_on(self) -> None:
        """Receive for a while; not from emulated drives in this process once they have nothing more to say."""
        end = time.monotonic() + LISTEN_ON_S
        while (left_s := end - time.monotonic()) > 0 and wait([self.wire], left_s):
            self._receive()
        self._receive()

    def _await(self, done: Callable[[int], bool], ask: Callable[[int], object]) -> None:
        end, ask_at = time.monotonic() + self._bring_up_s, 0.0
        while (now := time.monotonic()) < end and not all(map(done, range(len(self.nodes)))):
            if now >= ask_at:
                for i in range(len(self.nodes)):
                    ask(i)
                ask_at = now + ASK_EVERY_S
            for _, frame in receive_frames([self.wire]):
                self.take(frame)
