"""Joint modules on their buses: a `snakesim_drivers.kit.drive_backend.Drives`. Thin: every task has its own file.

A tick: Sync is sent, every module answers with its samples of that instant, and enacts the setpoint that it received
in the period before. So a command acts exactly one period after the state that it answers, whatever the load.
"""

import logging
import time
from dataclasses import dataclass, field
from pathlib import Path

from snakesim_can_backend.bus.adapter import open_wire
from snakesim_can_backend.bus.bus import VirtualPeer, VirtualWire, Wire, inject_into, make_virtual_channel, wait
from snakesim_can_backend.bus.load import joints_per_bus, plan_reports, worst_frame_bits
from snakesim_can_backend.bus.log import LoggedWire, open_log
from snakesim_can_backend.driver.bring_up import ModuleBus, configure_modules, discovery_errors, find_modules
from snakesim_can_backend.driver.module_monitor import ARM_GRACE, ModuleMonitor
from snakesim_can_backend.driver.own_emulators import EmulatorProcess, start_local_emulators, supports_fault
from snakesim_can_backend.driver.parameters import check_ratings, plan_parameters
from snakesim_can_backend.driver.reports import ModuleReports
from snakesim_can_backend.driver.sensors import contacts_due
from snakesim_can_backend.protocol import commands
from snakesim_can_backend.protocol.definitions import CommandAction, Frame, ModuleState
from snakesim_can_backend.settings import CanSettings
from snakesim_drivers.kit.drive_backend import Clock
from snakesim_drivers.kit.findings import Finding
from snakesim_drivers.kit.readings import Readings
from snakesim_hal.backend import Setpoints
from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import BackendError
from snakesim_hal.model.fault_kinds import Injection
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.wire.messages import LifecycleState, Mode

ANSWER_MARGIN = 1.25  # of the bus time that all answers take
ANSWER_SLACK_S = 0.002
MAX_OF_PERIOD = 0.75
CONFIGURE_LIMIT_S = 1.0  # while the robot is up; an emergency stop waits no longer than that, with motors off
LOCKSTEP_ANSWER_S = 2.0  # to wait for slow emulators; dead ones are not waited for again
FIRST_STATE_SYNCS = 20
FIRST_STATE_PAUSE_S = 0.02
LEFT_BEHIND = {"watchdog", "stream"}  # faults of a module whose driver was killed

_log = logging.getLogger("snakesim.can")


@dataclass
class ArmSession:
    """The newest arming: its first Sync, and which joints have followed."""

    sync: int = -1
    done: set[int] = field(default_factory=set[int])


class JointModules:
    """All joint modules of a robot; joint i is node i + 1."""

    emulated = False  # until they have said so

    def __init__(
        self, config: RunConfig, settings: CanSettings, clock: Clock, pose: str | None, readings: Readings
    ) -> None:
        """Open the buses. Raises ConfigError and BackendError.

        pose: where own emulators send motion capture; readings: are told who each module is.
        """
        self._readings = readings
        self._config, self._settings, self._clock = config, settings, clock
        self._lockstep = config.clock_mode == "lockstep"
        self._reports = plan_reports(config, settings)
        self._names = [joint.name for joint in config.robot.joint_table]
        self.reading = ModuleReports(len(self._names))
        self.wires: list[Wire] = []
        self.local_emulators: VirtualPeer | None = None
        self._emulators: EmulatorProcess | None = None
        # Whether no other host uses the modules: before that is known, nothing that disturbs them is sent.
        self._ours = False
        self._unconfigured = set(range(len(self._names)))  # joints whose parameters may differ from the robot file
        self._setpoints = commands.SetpointWriter(len(self._names))
        self._lifecycle: LifecycleState = "disarmed"
        self._isolated: frozenset[int] = frozenset()  # isolated joints: motors off, and no setpoints
        self._unsent: list[str] = []
        self._arm_session = ArmSession()
        self._arms = self._all_cleared = False  # of this tick's change of the lifecycle
        self._answer_limit_s = LOCKSTEP_ANSWER_S if self._lockstep else FIRST_STATE_PAUSE_S
        try:
            self._buses = self._open_buses(joints_per_bus(config, settings), pose)
        except BaseException:
            self.close()
            raise
        self._wire_of = [bus.wire for bus in self._buses for _ in bus.nodes]
        channels = [wire.channel for wire in self._wire_of]
        self.monitor = ModuleMonitor(self._names, channels, config.period_ns * 1e-9)

    # --- Drives -----------------------------------------------------------------------------------------------

    def bring_up(self) -> None:
        """Find every module, check it, write its parameters; nothing is enabled."""
        limit_s = self._settings.bring_up_limit_s
        found = find_modules(self._buses, limit_s, self.reading.process_frame)
        if self.reading.from_other_host:
            raise BackendError("another program commands the modules on this bus; end it first. Nothing was sent")
        wrong = discovery_errors(self._buses, found, self._names, lockstep=self._lockstep)
        if wrong:
            raise BackendError("the robot is not complete; nothing was enabled:", *(f"  {what}" for what in wrong))
        self._ours = True
        self.emulated = all(identity.emulated for identity in found)
        for identity in found:
            self._readings.identified(identity.node - 1, serial=f"{identity.serial:08X}", firmware=identity.firmware)
        self._broadcast(commands.make_command(CommandAction.DISARM))
        self._configure(limit_s)
        self._await_first_states()
        self._forgive_old_faults()
        self._answer_limit_s = answer_limit_s(self._config, self._settings)

    def read(self) -> None:
        """Send Sync, and collect the modules' samples. Waits for late ones only for a limited time."""
        reading, questions = self.reading, self._questions()
        time_us = self._clock.ns() // 1000
        self._receive()
        due = contacts_due(self._reports, reading.sync + 1)
        reading.begin_sync(reading.sync + 1, contacts=due, tail=self._reports.tail, questions=len(questions))
        frame = commands.make_sync(reading.sync, time_us)
        self._unsent = [wire.channel for wire in self.wires if not wire.send(frame)]
        for wire, question in questions:
            wire.send(question)
        if reading.complete:  # no answer is expected; but emulators in this process run only while this one waits
            wait(self.wires, 0.0)
        end = time.monotonic() + self._answer_limit_s
        while not reading.complete and (left_s := end - time.monotonic()) > 0:
            if not wait(self.wires, left_s):
                break
            self._receive()

    def announce(self, lifecycle: LifecycleState, isolated: frozenset[int]) -> None:
        """Before anything else in a tick, for the rest may take a while: stop, disarm, and repeat what was missed."""
        before, self._lifecycle = self._lifecycle, lifecycle
        if lifecycle == before:
            self._remind(lifecycle)
        elif lifecycle == "armed":
            self._arm_session = ArmSession(self.reading.sync)
        frames = commands.make_transition_frames(before, lifecycle)
        self._arms = any(map(commands.is_arm_command, frames))
        self._all_cleared = before in commands.LATCHED
        for frame in frames:
            if not commands.is_arm_command(frame):
                self._broadcast(frame)
        fresh, self._isolated = isolated - self._isolated, isolated
        for i in sorted(fresh):
            self._wire_of[i].send(commands.make_command(CommandAction.DISARM, i + 1))

    def clear(self, joints: frozenset[int]) -> None:
        """Modules whose parameters may have changed are configured again, once, while motors are off.

        A module that is not configured then is reported as a fault, and nothing is armed.
        """
        self.monitor.reset(self.reading.sync)
        for i in sorted(joints) if not self._all_cleared else ():
            self._wire_of[i].send(commands.make_command(CommandAction.CLEAR, i + 1))
        if self._unconfigured:
            try:
                self._configure(CONFIGURE_LIMIT_S)
            except BackendError as error:
                _log.warning("after a clear: %s", error)

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
        """Armed: send the setpoints. Otherwise send none: the modules bring themselves to rest and stay passive."""
        if self._arms and not self._unconfigured - self._isolated:
            self._arm()
        self._arms = False
        if self._lifecycle != "armed":
            return
        points = Setpoints(modes, targets.tolist(), limits_nm.tolist(), self._isolated)
        for i, frame in enumerate(self._setpoints.encode(points)):
            if i not in following:
                continue
            if self._wire_of[i].send(frame):
                self._setpoints.confirm_sent(i)
            else:  # the queue is full or the interface down: the next setpoint replaces it
                self._unsent.append(self._wire_of[i].channel)

    def findings(self) -> list[Finding]:
        """Reported by the modules and the buses, or detected by the monitor."""
        errors = [error for wire in self.wires for error in wire.errors()]
        found = self.monitor.find_faults(
            self.reading, self._lifecycle, errors, self._unsent, self._unconfigured, self._isolated
        )
        self._unconfigured |= self.monitor.take_changed()
        return found

    def let_run(self) -> None:
        """Process frames received meanwhile."""
        if self._emulators is not None and (how := self._emulators.describe_exit()) is not None:
            raise BackendError(how)
        self._receive()

    def inject(self, injection: Injection, *, begins: bool) -> bool:
        """Faults of own emulators and buses; False for other kinds. Raises ConfigError."""
        if inject_into(self.wires, injection, begins=begins):
            return True
        emulators = self._emulators or self.local_emulators
        if emulators is None or not supports_fault(injection, len(self._wire_of)):
            return False
        emulators.inject(injection, begins=begins)
        return True

    def close(self) -> None:
        """Motors off, buses closed, own emulators ended."""
        for wire in self.wires:
            self._let_go(wire)
        if self._emulators is not None:
            self._emulators.stop()

    # --- inside -----------------------------------------------------------------------------------------------

    def _let_go(self, wire: Wire) -> None:
        """Motors off, and the bus closed, as far as it still works; errors do not prevent closing the other buses."""
        try:
            if self._ours:
                wire.send(commands.make_command(CommandAction.DISARM))
            wire.idle()
        except BackendError as error:
            _log.warning("closing: %s", error)
        try:
            wire.close()
        except BackendError as error:
            _log.warning("closing: %s", error)

    def _open_buses(self, joints_of: list[int], pose: str | None) -> list[ModuleBus]:
        settings = self._settings
        if settings.emulators_run == "process":
            self._emulators = EmulatorProcess(self._config, settings, pose, stepped=self._lockstep)
        for name in settings.channels or [make_virtual_channel()]:
            if settings.channels:
                self.wires.append(open_wire(name, bit_rate=settings.bit_rate))
            else:
                self.local_emulators = start_local_emulators(self._config, settings, name, pose, stepped=self._lockstep)
                self.wires.append(VirtualWire(name, self.local_emulators))
        if settings.log:
            log = open_log(Path(settings.log))
            self.wires = [LoggedWire(wire, log) for wire in self.wires]
        buses, first = [], 1
        for wire, count in zip(self.wires, joints_of, strict=True):
            buses.append(ModuleBus(wire, range(first, first + count)))
            first += count
        return buses

    def _forgive_old_faults(self) -> None:
        """Clear the faults that a killed driver has left; but not heat, leaks and emergencies."""
        for _ in range(FIRST_STATE_SYNCS):  # their heartbeats have the reason of the stop
            if all(module.faults or module.state != ModuleState.FAULT for module in self.reading.modules):
                break
            time.sleep(FIRST_STATE_PAUSE_S)
            self.read()
        for module, wire in zip(self.reading.modules, self._wire_of, strict=True):
            faults = module.fault_names()
            if module.state == ModuleState.FAULT and faults and set(faults) <= LEFT_BEHIND:
                _log.warning("node %d: clearing an earlier fault: %s", module.node, ", ".join(faults))
                wire.send(commands.make_command(CommandAction.CLEAR, module.node))

    def _configure(self, limit_s: float) -> None:
        """Write the parameters of every module that needs them. Raises BackendError."""
        wanted = plan_parameters(self._config.robot, self._settings, self._reports)
        due = {joint + 1: wanted[joint + 1] for joint in self._unconfigured}
        try:
            check_ratings(self._config.robot, configure_modules(self._buses, due, limit_s, self.reading.process_frame))
        finally:
            self.reading.reset_frame_counts()  # they arrived over more than one period
        self._unconfigured.clear()

    def _await_first_states(self) -> None:
        for _ in range(FIRST_STATE_SYNCS):
            self.read()
            if all(module.sync >= 0 for module in self.reading.modules):
                self.reading.unknown_nodes.clear()
                return
        silent = [name for name, module in zip(self._names, self.reading.modules, strict=True) if module.sync < 0]
        raise BackendError(f"{', '.join(silent)} did not answer {FIRST_STATE_SYNCS} Syncs; nothing was enabled")

    def _questions(self) -> list[tuple[Wire, Frame]]:
        """In lockstep, a question to emulators after each Sync: once it is answered, all earlier frames have arrived.

        Some reports come only at some Syncs, so that otherwise a missing one could still be on its way.
        """
        if self._emulators is None or not self._lockstep:
            return []
        asked: dict[str, tuple[Wire, Frame]] = {}
        for module, wire in zip(self.reading.modules, self._wire_of, strict=True):
            if module.sync >= 0 and module.sync == self.reading.sync:
                asked.setdefault(wire.channel, (wire, commands.make_query(module.node)))
        return list(asked.values())

    def _receive(self) -> None:
        take = self.reading.process_frame
        for wire in self.wires:
            for frame in wire.receive():
                take(frame)

    def _broadcast(self, frame: Frame) -> None:
        """Send to all buses; an error of one must not prevent sending on the others."""
        failed: BackendError | None = None
        for wire in self.wires:
            try:
                wire.send(frame)
            except BackendError as error:
                failed = error
        if failed is not None:
            raise failed

    def _remind(self, lifecycle: LifecycleState) -> None:
        """Repeat a command to modules that missed it. A module that was armed, and no longer is, has been stopped."""
        arm_session = self._arm_session
        in_time = self.reading.sync - arm_session.sync <= ARM_GRACE and not self._unconfigured - self._isolated
        for i, module in enumerate(self.reading.modules):
            if lifecycle == "armed" and i in self._isolated:
                if module.state in (ModuleState.ARMED, ModuleState.STOPPING):
                    self._wire_of[i].send(commands.make_command(CommandAction.DISARM, module.node))
                continue
            if lifecycle == "armed" and module.state == ModuleState.ARMED:
                arm_session.done.add(i)
            frame = commands.make_reminder(lifecycle, module.state, module.node)
            if frame is not None and (lifecycle != "armed" or (in_time and i not in arm_session.done)):
                self._wire_of[i].send(frame)

    def _arm(self) -> None:
        """Send arm to all modules, except isolated ones."""
        if not self._isolated:
            self._broadcast(commands.make_command(CommandAction.ARM))
            return
        for i, wire in enumerate(self._wire_of):
            if i not in self._isolated:
                wire.send(commands.make_command(CommandAction.ARM, i + 1))


def answer_limit_s(config: RunConfig, settings: CanSettings) -> float:
    """How long all answers to a Sync may take on the fullest bus; the rest of the period is for the controller."""
    if config.clock_mode == "lockstep":
        return LOCKSTEP_ANSWER_S
    reports = plan_reports(config, settings)
    frames = max(joints_per_bus(config, settings)) * (1 + (reports.contact_every > 0)) + reports.tail
    bus_s = frames * worst_frame_bits(8) / reports.bit_rate
    return min(ANSWER_MARGIN * bus_s + ANSWER_SLACK_S, MAX_OF_PERIOD / reports.rate_hz)
