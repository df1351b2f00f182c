"""Joint modules on CAN as a backend. Thin: every task has its own module.

A tick: Sync is sent, every module answers with its samples of that instant, and enacts the set-point that it received
in the period before. So a command acts exactly one period after the state that it answers, whatever the load.
"""

import logging
import time
import uuid
from dataclasses import dataclass, field

import msgspec
import numpy as np

from snakesim_can_backend.bus.adapter import check_channel, open_wire
from snakesim_can_backend.bus.bus import VirtualPeer, VirtualWire, Wire, inject_into, wait
from snakesim_can_backend.bus.bus_errors import BusError
from snakesim_can_backend.bus.load import check_load, reports_of, shares, worst_bits
from snakesim_can_backend.bus.log import logged
from snakesim_can_backend.driver.bring_up import Bus, configure, discovery_errors, find
from snakesim_can_backend.driver.module_monitor import ARM_GRACE, Watch
from snakesim_can_backend.driver.own_twins import TwinProcess, check_faults, check_twins, modules_know, twins_here
from snakesim_can_backend.driver.parameters import check_drives, check_ratings, check_watchdog, parameters_of
from snakesim_can_backend.driver.reports import Reading
from snakesim_can_backend.driver.sensors import Sensors, contacts_due, described
from snakesim_can_backend.protocol import commands
from snakesim_can_backend.protocol.definitions import Action, Frame, ModuleState
from snakesim_can_backend.settings import CanSettings
from snakesim_hal.backend import Samples, SetPoints
from snakesim_hal.drivers.findings import Finding
from snakesim_hal.drivers.mocap import MocapReceiver, check_pose, receiver
from snakesim_hal.drivers.mounted import check_mounted
from snakesim_hal.drivers.mounting import Mounting
from snakesim_hal.errors import BackendError
from snakesim_hal.injection import Injection
from snakesim_hal.model.robot import describe
from snakesim_hal.model.scenario import RunConfig, config_hash
from snakesim_hal.physics.motor import check_gains
from snakesim_hal.wire.messages import Description, Fault, LifecycleState, Pace

NAME = "can"
ANSWER_MARGIN = 1.25  # of the bus time that all answers take
ANSWER_SLACK_S = 0.002
MAX_OF_PERIOD = 0.75
CONFIGURE_LIMIT_S = 1.0  # while the robot is up; an emergency stop waits no longer than that, with motors off
LOCKSTEP_ANSWER_S = 2.0  # to wait for slow twins; dead ones are not waited for again
FIRST_STATE_SYNCS = 20
FIRST_STATE_PAUSE_S = 0.02
LEFT_BEHIND = {"watchdog", "stream"}  # faults of a module whose driver was killed

_log = logging.getLogger("snakesim.can")


@dataclass
class Arming:
    """The newest arming: its first Sync, and which joints have followed."""

    sync: int = -1
    done: set[int] = field(default_factory=set[int])


class CanBackend:
    """A `snakesim_hal.backend.Backend` on joint modules, real or emulated."""

    Settings = CanSettings

    @staticmethod
    def check(config: RunConfig, settings: CanSettings) -> tuple[Pace, ...]:
        """Real modules support real time only; twins that this backend starts support lockstep. Raises ConfigError."""
        check_load(config, settings)
        check_gains(config.robot)
        check_drives(config.robot, settings)
        check_mounted(config.robot, config.backend_section, settings.mounted, twins=settings.twins_run != "none")
        check_ratings(config.robot)
        check_watchdog(config, settings)
        check_pose(config, settings.pose_listen)
        check_twins(config, settings)
        check_faults(config, settings)
        for channel in settings.channels:
            check_channel(channel)
        return ("realtime",) if settings.twins_run == "none" else ("lockstep", "realtime")

    def __init__(self, config: RunConfig, settings: CanSettings) -> None:
        """Open the buses and find every module; nothing is enabled. Raises ConfigError and BackendError."""
        self.check(config, settings)
        self._config, self._settings = config, settings
        self._lockstep = config.pace == "lockstep"
        self._reports = reports_of(config, settings)
        joints = config.robot.chain.modules
        self._mocap: MocapReceiver | None = None
        self._twins: TwinProcess | None = None
        self._local_twins: VirtualPeer | None = None
        self._wires: list[Wire] = []
        self._open = True
        self._ours = (
            False  # whether no other host uses the modules: before that is known, nothing that disturbs them is sent
        )
        self._unconfigured = set(range(joints))  # joints whose parameters may differ from the robot file
        try:
            twins = settings.twins_run != "none"
            self._mocap = receiver(config, settings.pose_listen, twins=twins, clock=self._now_ns)
            self._buses = self._open_buses(shares(config, settings))
            self._reading = Reading(joints)
            self._description = self._describe()
            names = [joint.name for joint in self._description.joints]
            self._wire_of = [bus.wire for bus in self._buses for _ in bus.nodes]
            channels = [wire.channel for wire in self._wire_of]
            self._watch = Watch(names, channels, config.period_ns * 1e-9)
            self._bring_up(names)
        except BaseException:
            self.close()
            raise
        self._mounting = Mounting(config.robot.joint_table)
        self._sensors = Sensors(config, self._reports, self._reading, self._mocap)
        self._set_points = commands.SetPointWriter(joints)
        self._lifecycle: LifecycleState = "disarmed"
        self._isolated: frozenset[int] = frozenset()  # isolated joints: motors off, and no set-points
        self._pending: frozenset[int] = frozenset()  # joints just reported as failed, whose isolation is expected
        self._unsent: list[str] = []
        self._arming = Arming()
        self._answer_limit_s = answer_limit_s(config, settings)
        self._tick = 0

    def describe(self) -> Description:
        """The robot of the robot file, with the sensors of its modules."""
        return self._description

    def sample(self, tick: int, stamp_ns: int) -> Samples:
        """Send Sync, and collect the modules' samples. Waits for late ones only for a limited time."""
        self._must_be_open()
        self._tick = tick
        self._sync(stamp_ns)
        return self._sensors.sample(tick, stamp_ns)

    def enact(self, set_points: SetPoints, lifecycle: LifecycleState) -> None:
        """Armed: send the set-points. Otherwise send none: the modules bring themselves to rest and stay passive."""
        if not self._open:
            return
        if lifecycle == self._lifecycle:
            self._remind(lifecycle)
        elif lifecycle == "armed":
            self._arming = Arming(self._reading.sync)
        frames = commands.on_change(self._lifecycle, lifecycle)
        for frame in frames:
            if not commands.is_arming(frame):
                self._broadcast(frame)  # stop and disarm first: the rest may take a while
        back = self._isolate(set_points.isolated)
        if lifecycle not in commands.LATCHED and (back or self._lifecycle in commands.LATCHED):
            self._cleared(back)  # before the arm command: parameters are written while motors are off
        if any(map(commands.is_arming, frames)) and not self._unconfigured - self._isolated:
            self._arm()
        self._lifecycle = lifecycle
        if lifecycle != "armed":
            return
        for i, frame in enumerate(self._set_points.frames(_at_the_shafts(self._mounting, set_points))):
            if i in self._isolated:
                continue
            if self._wire_of[i].send(frame):
                self._set_points.sent(i)
            else:  # the queue is full or the interface down: the next set-point replaces it
                self._unsent.append(self._wire_of[i].channel)

    def advance(self) -> None:
        """Time passes by itself: process frames received meanwhile. Raises BackendError when closed."""
        self._must_be_open()
        if self._twins is not None and (how := self._twins.how_it_ended()) is not None:
            raise BackendError(how)
        self._receive()

    def faults(self) -> list[Fault]:
        """Faults reported by the modules and the buses, or detected by the driver."""
        if not self._open:
            return []
        errors: list[BusError] = [error for wire in self._wires for error in wire.errors()]
        names = self._description.joints
        found = self._watch.look(
            self._reading, self._lifecycle, errors, self._unsent, self._unconfigured, self._isolated
        )
        failed = frozenset(finding.joint for finding in found if finding.joint is not None)
        few = len(self._isolated | failed) <= self._description.may_lose_joints
        if self._lifecycle == "armed" and few and all(finding.alone for finding in found):
            self._pending |= failed  # the HAL isolates them
        elif found and self._lifecycle not in commands.LATCHED:
            # Stopped here and now. From now on only a clear ends it, also one that comes before the next period.
            try:
                for frame in commands.on_change(self._lifecycle, "fault"):
                    self._broadcast(frame)
            except BackendError as error:  # the faults are reported all the same; the failing bus raises again
                found.append(Finding("stop_not_sent", str(error)))
            self._lifecycle = "fault"
        self._unconfigured |= self._watch.take_changed()
        joints = [joint.name for joint in names]
        return [finding.fault(self._tick, joints) for finding in found]

    def inject(self, injection: Injection, *, begins: bool) -> bool:
        """Injects faults of own twins and buses; False for other kinds. Raises ConfigError."""
        if inject_into(self._wires, injection, begins=begins):
            return True
        twins = self._twins or self._local_twins
        if twins is None or not modules_know(injection, len(self._wire_of)):
            return False
        twins.inject(injection, begins=begins)
        return True

    def close(self) -> None:
        """Motors off, buses closed, own twins ended."""
        if not self._open:
            return
        self._open = False
        for wire in self._wires:
            self._let_go(wire)
        if self._twins is not None:
            self._twins.stop()
        if self._mocap is not None:
            self._mocap.close()

    # --- inside -----------------------------------------------------------------------------------------------

    def _let_go(self, wire: Wire) -> None:
        """Motors off, and the bus closed, as far as it still works; errors do not prevent closing the other buses."""
        try:
            if self._ours:
                wire.send(commands.command(Action.DISARM))
            wire.idle()
        except BackendError as error:
            _log.warning("closing: %s", error)
        try:
            wire.close()
        except BackendError as error:
            _log.warning("closing: %s", error)

    def _must_be_open(self) -> None:
        if not self._open:
            raise BackendError("the buses are closed; open a new backend")

    def _describe(self) -> Description:
        config = self._config
        plain = describe(
            config.robot,
            backend=NAME,
            period_ns=config.period_ns,
            lease_ns=config.lease_ns,
            config_hash=config_hash(config),
        )
        camera = config.robot.sensors.pose
        delay_s = camera.delay_s if camera is not None and self._mocap is not None else None
        sensors = described(config, self._reports, pose_delay_s=delay_s)
        return msgspec.structs.replace(plain, sensors=sensors, hardware="+".join(self._settings.channels))

    def _open_buses(self, joints_of: list[int]) -> list[Bus]:
        settings = self._settings
        pose = self._mocap.address if self._mocap is not None else None
        if settings.twins_run == "process":
            self._twins = TwinProcess(self._config, settings, pose, stepped=self._lockstep)
        names = settings.channels or [f"virtual-{uuid.uuid4().hex[:8]}"]
        for name in names:
            if settings.channels:
                self._wires.append(open_wire(name, bit_rate=settings.bit_rate))
            else:
                self._local_twins = twins_here(self._config, settings, name, pose, stepped=self._lockstep)
                self._wires.append(VirtualWire(name, self._local_twins))
        self._wires = logged(self._wires, settings.log)
        buses, first = [], 1
        for wire, count in zip(self._wires, joints_of, strict=True):
            buses.append(Bus(wire, range(first, first + count)))
            first += count
        return buses

    def _bring_up(self, names: list[str]) -> None:
        limit_s = self._settings.bring_up_limit_s
        found = find(self._buses, limit_s, self._reading.take)
        if self._reading.from_other_host:
            raise BackendError("another program commands the modules on this bus; end it first. Nothing was sent")
        wrong = discovery_errors(self._buses, found, names, lockstep=self._lockstep)
        if wrong:
            raise BackendError("the robot is not complete; nothing was enabled:", *(f"  {what}" for what in wrong))
        self._ours = True
        emulated = all(identity.emulated for identity in found)
        self._description = msgspec.structs.replace(self._description, emulated=emulated)
        self._broadcast(commands.command(Action.DISARM))
        self._configure(limit_s)
        self._await_first_states(names)
        self._forgive_old_faults()

    def _forgive_old_faults(self) -> None:
        """Clear the faults that a killed driver has left; but not heat, leaks and emergencies."""
        for _ in range(FIRST_STATE_SYNCS):  # their heartbeats have the reason of the stop
            if all(module.faults or module.state != ModuleState.FAULT for module in self._reading.modules):
                break
            time.sleep(FIRST_STATE_PAUSE_S)
            self._sync(stamp_ns=0)
        for module, wire in zip(self._reading.modules, self._wire_of, strict=True):
            faults = module.fault_names()
            if module.state == ModuleState.FAULT and faults and set(faults) <= LEFT_BEHIND:
                _log.warning("node %d: clearing an earlier fault: %s", module.node, ", ".join(faults))
                wire.send(commands.command(Action.CLEAR, module.node))

    def _configure(self, limit_s: float) -> None:
        """Write the parameters of every module that needs them. Raises BackendError."""
        wanted = parameters_of(self._config.robot, self._settings, self._reports)
        due = {joint + 1: wanted[joint + 1] for joint in self._unconfigured}
        try:
            check_ratings(self._config.robot, configure(self._buses, due, limit_s, self._reading.take))
        finally:
            self._reading.forget_frames()  # they arrived over more than one period
        self._unconfigured.clear()

    def _await_first_states(self, names: list[str]) -> None:
        self._answer_limit_s = LOCKSTEP_ANSWER_S if self._lockstep else FIRST_STATE_PAUSE_S
        for _ in range(FIRST_STATE_SYNCS):
            self._sync(stamp_ns=0)
            if all(module.sync >= 0 for module in self._reading.modules):
                self._reading.strangers.clear()
                return
        silent = [name for name, module in zip(names, self._reading.modules, strict=True) if module.sync < 0]
        raise BackendError(f"{', '.join(silent)} did not answer {FIRST_STATE_SYNCS} Syncs; nothing was enabled")

    def _sync(self, stamp_ns: int) -> None:
        reading, questions = self._reading, self._questions()
        time_us = self._now_ns(stamp_ns) // 1000
        self._receive()
        due = contacts_due(self._reports, reading.sync + 1)
        reading.begin(reading.sync + 1, contacts=due, tail=self._reports.tail, questions=len(questions))
        frame = commands.sync(reading.sync, time_us)
        self._unsent = [wire.channel for wire in self._wires if not wire.send(frame)]
        for wire, question in questions:
            wire.send(question)
        if reading.complete:  # no answer is expected; but twins in this process run only while this one waits
            wait(self._wires, 0.0)
        end = time.monotonic() + self._answer_limit_s
        while not reading.complete and (left_s := end - time.monotonic()) > 0:
            if not wait(self._wires, left_s):
                break
            self._receive()

    def _now_ns(self, stamp_ns: int) -> int:
        """The time of this driver's clock: in lockstep robot time, the tick's stamp."""
        return stamp_ns if self._lockstep else time.monotonic_ns()

    def _questions(self) -> list[tuple[Wire, Frame]]:
        """In lockstep, a question to twins after each Sync: once it is answered, all earlier frames have arrived.

        Some reports come only at some Syncs, so that otherwise a missing one could still be on its way.
        """
        if self._twins is None or not self._lockstep:
            return []
        asked: dict[str, tuple[Wire, Frame]] = {}
        for module, wire in zip(self._reading.modules, self._wire_of, strict=True):
            if module.sync >= 0 and module.sync == self._reading.sync:
                asked.setdefault(wire.channel, (wire, commands.question(module.node)))
        return list(asked.values())

    def _receive(self) -> None:
        take = self._reading.take
        for wire in self._wires:
            for frame in wire.receive():
                take(frame)

    def _broadcast(self, frame: Frame) -> None:
        """Send to all buses; an error of one must not prevent sending on the others."""
        failed: BackendError | None = None
        for wire in self._wires:
            try:
                wire.send(frame)
            except BackendError as error:
                failed = error
        if failed is not None:
            raise failed

    def _remind(self, lifecycle: LifecycleState) -> None:
        """Repeat a command to modules that missed it. A module that was armed, and no longer is, has been stopped."""
        arming = self._arming
        in_time = self._reading.sync - arming.sync <= ARM_GRACE and not self._unconfigured - self._isolated
        for i, module in enumerate(self._reading.modules):
            if lifecycle == "armed" and i in self._isolated:
                if module.state in (ModuleState.ARMED, ModuleState.STOPPING):
                    self._wire_of[i].send(commands.command(Action.DISARM, module.node))
                continue
            if lifecycle == "armed" and module.state == ModuleState.ARMED:
                arming.done.add(i)
            frame = commands.reminder(lifecycle, module.state, module.node)
            if frame is not None and (lifecycle != "armed" or (in_time and i not in arming.done)):
                self._wire_of[i].send(frame)

    def _isolate(self, isolated: frozenset[int]) -> frozenset[int]:
        """Switch off the newly isolated modules; returns the joints whose isolation has ended.

        These include joints just reported as failed, if they were cleared before their isolation was seen here.
        """
        fresh, back = isolated - self._isolated, (self._isolated | self._pending) - isolated
        self._isolated, self._pending = isolated, frozenset()
        for i in sorted(fresh):
            self._wire_of[i].send(commands.command(Action.DISARM, i + 1))
        return back

    def _arm(self) -> None:
        """Send arm to all modules, except isolated ones."""
        if not self._isolated:
            self._broadcast(commands.command(Action.ARM))
            return
        for i, wire in enumerate(self._wire_of):
            if i not in self._isolated:
                wire.send(commands.command(Action.ARM, i + 1))

    def _cleared(self, back: frozenset[int]) -> None:
        """The fault was cleared. Modules whose parameters may have changed are configured again, once.

        A module that is not configured then is reported as a fault, and nothing is armed. back: joints to use again.
        """
        self._watch.forget(self._reading.sync)
        for i in sorted(back):
            self._wire_of[i].send(commands.command(Action.CLEAR, i + 1))
        if self._unconfigured:
            try:
                self._configure(CONFIGURE_LIMIT_S)
            except BackendError as error:
                _log.warning("after a clear: %s", error)


def _at_the_shafts(mounting: Mounting, points: SetPoints) -> SetPoints:
    """Set-points of the joints -> of the modules."""
    targets = mounting.drive_targets(points.mode, points.target).tolist()
    limits = mounting.drive_torque_limit_nm(np.array(points.torque_limit_nm)).tolist()
    return SetPoints(points.mode, targets, limits, points.isolated)


def answer_limit_s(config: RunConfig, settings: CanSettings) -> float:
    """How long all answers to a Sync may take on the fullest bus; the rest of the period is for the controller."""
    if config.pace == "lockstep":
        return LOCKSTEP_ANSWER_S
    reports = reports_of(config, settings)
    frames = max(shares(config, settings)) * (1 + (reports.contact_every > 0)) + reports.tail
    bus_s = frames * worst_bits(8) / reports.bit_rate
    return min(ANSWER_MARGIN * bus_s + ANSWER_SLACK_S, MAX_OF_PERIOD / reports.rate_hz)
