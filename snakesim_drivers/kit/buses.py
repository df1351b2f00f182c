"""The buses of a robot, each with its own drives and, in real time, in a thread of its own.

A bus is asked once a tick, or every so many, for what its drives measure, and told their setpoints. Whoever is slow
delays nobody: the host waits for a bus only if that answered in time when it was last asked; until then its joints keep
their last values, whose age grows. Of setpoints the newest is sent; none that is older than a lease: a bus that gets
no others lets its drives go. What cannot be sent is the business of the drives' own watchdogs.

Drives stop by themselves while a driver is away. After a pause in which a watchdog may have expired, a bus first reads
the state of every drive, and only then sends anything; see `drive_guard`.

In lockstep the same is done in turn, in the host's thread, and a run is the same each time.
"""

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from snakesim_drivers.kit.drive_backend import CLEAR_GRACE, Drives
from snakesim_drivers.kit.drive_guard import DriveGuard
from snakesim_drivers.kit.drive_settings import answer_limit_s
from snakesim_drivers.kit.findings import Finding
from snakesim_drivers.kit.readings import DriveReadings
from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import BackendError, ConfigError
from snakesim_hal.model.fault_kinds import Injection
from snakesim_hal.model.joints import Joint
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.wire.messages import Mode

WAITS_FOR = 1.2  # of the time that drives have for an answer
SLICES = 6  # of that time
CLOSES_WITHIN_S = 2.0
GAP_OF_WATCHDOG = 0.5  # a longer pause, as a fraction of the watchdog's time, may have let watchdogs expire
MAX_READINGS_AFTER_PAUSE = 3  # the computer may pause again while states are read

_log = logging.getLogger("snakesim.drivers")


@dataclass(frozen=True)
class Bus:
    """Drives that share a wire."""

    name: str  # such as can0
    joints: tuple[int, ...]  # numbers in the robot
    open: Callable[[DriveReadings], Drives]  # with readings of these drives alone. Raises ConfigError and BackendError
    decimation: int = 1
    watchdog_s: float = 0.1  # of its drives


class BusCommand(NamedTuple):
    """Setpoints of the drives of a bus, at their shafts."""

    following: frozenset[int]
    modes: list[Mode]
    targets: Floats
    limits_nm: Floats
    may_enable: bool  # the robot is armed: drives that are off may be enabled
    emergency: bool


class InlineBus:
    """One bus. Numbers of joints are those on it."""

    def __init__(self, bus: Bus, joints: Sequence[Joint], clock_ns: Callable[[], int], period_ns: int) -> None:
        """joints: of the robot; period_ns: of its ticks."""
        self.bus = bus
        self.readings = DriveReadings([joints[j] for j in bus.joints], clock_ns)
        self.drives = bus.open(self.readings)
        self.last: tuple[frozenset[int], bool, bool] | None = None  # who was told to follow, or to stop
        self.slower_s = 0.0  # an injected fault, of a bus in a thread
        self._gap_ns = round(GAP_OF_WATCHDOG * bus.watchdog_s * 1e9)
        grace_ns = CLEAR_GRACE * bus.decimation * period_ns
        self._guard = DriveGuard(clock_ns, gap_ns=self._gap_ns, grace_ns=grace_ns)
        self._found_early: list[Finding] = []  # before setpoints were sent

    def begin(self) -> None:
        """Ticks begin."""

    def ask(self) -> bool:
        """What its drives measure; False: it is still busy."""
        if not self._read_states_after_a_pause():
            self._read_drives()
        return True

    def wait(self, slices: int) -> int:
        """Until it has answered; not for one that was slow. Returns how many slices of time are left."""
        return slices

    def say(self, readings: DriveReadings) -> None:
        """What its drives have said, into those of the robot. Raises what has gone wrong on it."""
        readings.copy_from(self.readings, self.bus.joints)

    def tell(self, told: BusCommand) -> None:
        """Setpoints; any earlier ones need not be sent any more."""
        self._read_states_after_a_pause()
        self.drives.command(
            self._guard.drives_to_command(told.following, may_enable=told.may_enable),
            told.modes,
            told.targets,
            told.limits_nm,
            may_enable=told.may_enable,
            emergency=told.emergency,
        )

    def reset_faults(self, joints: frozenset[int]) -> None:
        """Errors of these drives."""
        self._read_states_after_a_pause()
        self._guard.reset(joints)
        self.drives.reset_faults(joints)

    def poll(self) -> None:
        """Receive."""
        self.drives.poll()

    def findings(self) -> list[Finding]:
        """What is wrong."""
        return self._collect_findings()

    def finish(self) -> None:
        """No more will be asked."""

    def close(self, until_s: float) -> None:
        """Motors off, bus closed; until_s: by when. Raises BackendError."""
        del until_s
        self.drives.close()

    # --- inside -----------------------------------------------------------------------------------------------

    def _read_states_after_a_pause(self) -> bool:
        """After a pause of the driver: read whether drives have stopped by themselves. Returns whether it did.

        A stop that a drive has latched would be lost with the next command that lets it go or clears its errors.
        """
        self._guard.mark_active()
        if not self._guard.was_away:
            return False
        for _ in range(MAX_READINGS_AFTER_PAUSE):
            self._guard.mark_states_read()
            self.drives.poll()  # receives what drives sent before the pause, which says nothing of their state now
            self.readings.require_check(range(len(self.bus.joints)))
            self._read_drives()
            self._guard.mark_active()
            if not self._guard.was_away:
                break
        self._found_early = self._collect_findings()
        return True

    def _read_drives(self) -> None:
        """Ask all drives. Those that have been silent for long are asked for their state, too."""
        silent = [i for i in range(len(self.bus.joints)) if self.readings.age_ns(i) > self._gap_ns]
        self.readings.require_check(silent)
        self.readings.count_request()
        self.drives.read()
        self._guard.mark_active()

    def _collect_findings(self) -> list[Finding]:
        found = [*self._found_early, *self.drives.findings()]
        self._found_early = []
        self._guard.note_findings(found)
        return found


class ThreadedBus(InlineBus):
    """The same in a thread, which alone uses the drives from `begin` on."""

    def __init__(
        self,
        bus: Bus,
        joints: Sequence[Joint],
        clock_ns: Callable[[], int],
        period_ns: int,
        lease_ns: int,
        waits_s: float,
    ) -> None:
        """waits_s: that the host waits for an answer at most."""
        super().__init__(bus, joints, clock_ns, period_ns)
        self._lease_s, self._slice_s = lease_ns * 1e-9, waits_s / SLICES
        self._took_s, self._slow = 0.0, False
        self._said = DriveReadings([joints[j] for j in bus.joints], clock_ns)
        self._thread: threading.Thread | None = None
        self._has = threading.Condition()  # guards all below
        self._closing = False
        self._asked_s: float | None = None  # when it was asked, until it has answered
        self._again = False  # asked since then: it reads again at once, at its own rate
        self._told: tuple[BusCommand, float] | None = None  # and when, until it is sent
        self._to_clear: frozenset[int] = frozenset()
        self._fed_s: float | None = None  # when the setpoints that its drives follow were told; None: none follows
        self._found: list[Finding] = []
        self._failed: Exception | None = None

    # --- in the host's thread ---------------------------------------------------------------------------------

    def begin(self) -> None:
        """Its thread; with the priority of this one."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name=f"bus {self.bus.name}", daemon=True)
            self._thread.start()

    def ask(self) -> bool:
        """It reads in its thread."""
        with self._has:
            if self._asked_s is not None:
                self._again = True
                return False
            self._slow = self._slow and self._took_s > SLICES * self._slice_s
            self._asked_s = time.monotonic()
            self._has.notify_all()
            return True

    def wait(self, slices: int) -> int:
        """In slices, as a computer that pauses must not take it for a slow bus."""
        with self._has:
            while slices > 0 and self._asked_s is not None and not self._slow:
                slices -= not self._has.wait(self._slice_s)
            self._slow = self._asked_s is not None
        return slices

    def say(self, readings: DriveReadings) -> None:
        """As of its last answer."""
        with self._has:
            self._raise()
            readings.copy_from(self._said, self.bus.joints)

    def tell(self, told: BusCommand) -> None:
        """To be sent as soon as it is free."""
        with self._has:
            self._told = told, time.monotonic()
            self._has.notify_all()

    def reset_faults(self, joints: frozenset[int]) -> None:
        """Before the next setpoints."""
        with self._has:
            self._to_clear |= joints
            self._found = of_buses(self._found)  # of drives it is of before the clear
            self._has.notify_all()

    def poll(self) -> None:
        """It does by itself."""

    def findings(self) -> list[Finding]:
        """Whatever was wrong when it was told setpoints, since the last call."""
        with self._has:
            self._raise()
            found, self._found = self._found, []
            return found

    def finish(self) -> None:
        """It lets its drives go, and closes."""
        with self._has:
            self._closing, self._failed, self._asked_s = True, None, None
            self._has.notify_all()

    def close(self, until_s: float) -> None:
        """Unless it hangs: then its drives stop by their watchdogs."""
        if self._thread is None:
            self.drives.close()
            return
        self._thread.join(max(until_s - time.monotonic(), 0.0))
        if self._thread.is_alive():
            _log.warning("%s: still busy; it is left, and its drives stop by their own watchdogs", self.bus.name)
            return
        with self._has:
            self._raise()

    def _raise(self) -> None:
        if self._failed is not None:
            raise self._failed

    # --- in its own -------------------------------------------------------------------------------------------

    def _run(self) -> None:
        closing = False
        while not closing:
            closing = self._closing  # what was told before is still sent
            try:
                self._turn()
            except Exception as error:  # noqa: BLE001 - the host ends the run for it; this thread goes on to stop drives
                with self._has:
                    self._failed, self._asked_s = self._failed or error, None
                    self._has.notify_all()
                with contextlib.suppress(Exception):
                    self._let_go()
        try:
            self.drives.close()
        except Exception as error:  # noqa: BLE001 - raised by `close`
            with self._has:
                self._failed = error

    def _turn(self) -> None:
        """Wait for something to do, and do it: first of all what stops or moves the drives."""
        with self._has:
            self._has.wait_for(self._due, self._left_s())
            asked, told, clears = self._asked_s is not None, self._told, self._to_clear
            self._told, self._to_clear = None, frozenset()
            moves = told is not None and bool(told[0].following)
            may_move = told is not None and time.monotonic() - told[1] <= self._lease_s and self._failed is None
        if clears:
            super().reset_faults(clears)
        if told is not None and (may_move or not moves):
            self._send(*told)
        elif told is not None or self._left_s() == 0:
            self._let_go()
        if asked:
            self._read()

    def _due(self) -> bool:
        return self._asked_s is not None or self._closing or self._told is not None or bool(self._to_clear)

    def _left_s(self) -> float | None:
        """Until the drives have to be let go."""
        return None if self._fed_s is None else max(self._fed_s + self._lease_s - time.monotonic(), 0.0)

    def _send(self, told: BusCommand, at_s: float) -> None:
        super().tell(told)
        self._fed_s = at_s if told.following else None
        self.drives.poll()
        self._report_findings()

    def _let_go(self) -> None:
        """Switch all drives off; they stay off until the operator resets the fault that this is."""
        self._fed_s, count = None, len(self.bus.joints)
        self._read_states_after_a_pause()
        if self._guard.release_drives():
            self._found_early.append(Finding("no_setpoints", self._starved()))
        none = np.zeros(count)
        super().tell(BusCommand(frozenset(), [Mode.PASSIVE] * count, none, none, may_enable=False, emergency=False))
        self.drives.poll()
        self._report_findings()

    def _starved(self) -> str:
        lease_ms = 1e3 * self._lease_s
        return f"{self.bus.name}: no setpoints for {lease_ms:.0f} ms, one lease: its drives were switched off"

    def _report_findings(self) -> None:
        found = self._collect_findings()
        with self._has:
            self._found += of_buses(found) if self._to_clear else found

    def _read(self) -> None:
        time.sleep(self.slower_s)
        super().ask()
        with self._has:
            self._said.copy_from(self.readings, range(len(self.bus.joints)))
            if self._asked_s is not None:
                now_s = time.monotonic()
                self._took_s, self._asked_s, self._again = now_s - self._asked_s, now_s if self._again else None, False
            self._has.notify_all()


def of_buses(found: list[Finding]) -> list[Finding]:
    """Those of no drive."""
    return [finding for finding in found if finding.joint is None]


class Buses:
    """All buses of a robot, as one `Drives`."""

    def __init__(
        self, config: RunConfig, readings: DriveReadings, buses: Sequence[Bus], clock_ns: Callable[[], int]
    ) -> None:
        """readings: of the robot. Raises ConfigError and BackendError."""
        self._readings, self._ticks = readings, 0
        waits_s = WAITS_FOR * answer_limit_s(config)
        self.lines: list[InlineBus] = []
        joints = config.robot.joint_table
        try:
            for bus in buses:
                if config.clock_mode == "lockstep":
                    self.lines.append(InlineBus(bus, joints, clock_ns, config.period_ns))
                else:
                    self.lines.append(ThreadedBus(bus, joints, clock_ns, config.period_ns, config.lease_ns, waits_s))
        except BaseException:
            self.close()
            raise
        self.emulated = all(line.drives.emulated for line in self.lines)

    def bring_up(self) -> None:
        """One after another; what is wrong with any of them is said at once."""
        wrong: list[BackendError] = []
        for line in self.lines:
            try:
                line.drives.bring_up()
            except BackendError as error:
                wrong.append(error)
        if wrong:
            raise BackendError(*dict.fromkeys(text for error in wrong for text in error.lines))
        for line in self.lines:
            self._readings.copy_from(line.readings, line.bus.joints)

    def read(self) -> None:
        """Ask all whose turn it is, and wait for those that are quick."""
        asked: list[InlineBus] = []
        for line in self.lines:
            line.begin()
            if self._is_turn(line) and line.ask():
                asked.append(line)
        slices = SLICES
        for line in asked:
            slices = line.wait(slices)
        for line in self.lines:
            line.say(self._readings)

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
        """Tell all whose turn it is, and at once whoever is to begin or to stop."""
        for line in self.lines:
            at = list(line.bus.joints)
            mine = frozenset(i for i, j in enumerate(at) if j in following)
            now = mine, may_enable, emergency
            if self._is_turn(line) or line.last != now:
                line.last = now
                line.tell(BusCommand(mine, [modes[j] for j in at], targets[at], limits_nm[at], may_enable, emergency))
        self._ticks += 1

    def reset_faults(self, joints: frozenset[int]) -> None:
        """Of each bus those on it."""
        for line in self.lines:
            if mine := frozenset(i for i, j in enumerate(line.bus.joints) if j in joints):
                line.reset_faults(mine)

    def findings(self) -> list[Finding]:
        """Of all."""
        return [
            finding if finding.joint is None else replace(finding, joint=line.bus.joints[finding.joint])
            for line in self.lines
            for finding in line.findings()
        ]

    def poll(self) -> None:
        """All."""
        for line in self.lines:
            line.poll()

    def inject(self, injection: Injection, *, begins: bool) -> bool:
        """A fault of a bus, by its number here, or of a drive on one."""
        kind, number = injection.target_type, injection.number if injection.target_type in ("bus", "joint") else -1
        for k, line in enumerate(self.lines):
            if kind == "bus" and k == number and injection.kind == "slow":
                line.slower_s = (injection.amount or 0.0) if begins else 0.0
                return True
            if kind == "bus" and k == number:
                return line.drives.inject(replace(injection, target="bus_1"), begins=begins)
            if kind == "joint" and number in line.bus.joints:
                on_it = f"joint_{line.bus.joints.index(number) + 1}"
                return line.drives.inject(replace(injection, target=on_it), begins=begins)
        if kind == "bus":
            raise ConfigError(f"there is no {injection.target}; this robot has bus_1 to bus_{len(self.lines)}")
        return False

    def close(self) -> None:
        """All, and none has to wait for another that hangs. Raises BackendError."""
        for line in self.lines:
            line.finish()
        until_s = time.monotonic() + CLOSES_WITHIN_S
        with contextlib.ExitStack() as everyone:
            for line in self.lines:
                everyone.callback(line.close, until_s)

    def _is_turn(self, line: InlineBus) -> bool:
        return self._ticks % line.bus.decimation == 0
