"""The joint modules of a robot on their buses, as `snakesim_drivers.kit.drives.Drives`.

In every control cycle the driver sends a Sync. Every module answers with its samples of that moment, and then follows
the setpoint that it received in the period before. So a command acts exactly one period after the state that it
answers, whatever the load of the bus.
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
from snakesim_can_backend.driver.reports import ModuleReports, ModuleStatus
from snakesim_can_backend.driver.sensors import contacts_due
from snakesim_can_backend.protocol import commands
from snakesim_can_backend.protocol.definitions import CommandAction, Frame, ModuleState
from snakesim_can_backend.settings import CanSettings
from snakesim_drivers.kit.drive_backend import DriverClock
from snakesim_drivers.kit.drives import BusCommand, Drives
from snakesim_drivers.kit.findings import Finding
from snakesim_drivers.kit.readings import DriveReadings
from snakesim_hal.base.errors import BackendError
from snakesim_hal.model.fault_kinds import Injection
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.wire.messages import LifecycleState

ANSWER_MARGIN = 1.25  # on the bus time that all answers take
ANSWER_SLACK_S = 0.002  # latency of the adapter and of this process
MAX_OF_PERIOD = 0.75  # the rest of a period is for the controller
CONFIGURE_LIMIT_S = 1.0  # while the robot is up; an emergency stop waits no longer than that, with motors off
LOCKSTEP_ANSWER_S = 2.0  # to wait for slow emulators; dead ones are not waited for again
FIRST_STATE_SYNCS = 20  # within which every module must send its first state
FIRST_STATE_PAUSE_S = 0.02
FAULTS_OF_KILLED_DRIVER = {"watchdog", "stream"}  # of a module whose driver ended without disarming it
FRAME_BYTES = 8  # of the longest frame on classic CAN

_log = logging.getLogger("snakesim.can")


@dataclass
class ArmSession:
    """The newest arming: its first Sync, and which joints have followed."""

    sync: int = -1
    armed_joints: set[int] = field(default_factory=set[int])


class JointModules(Drives):
    """All joint modules of a robot. Joint i is node i + 1."""

    def __init__(
        self, config: RunConfig, settings: CanSettings, clock: DriverClock, pose: str | None, readings: DriveReadings
    ) -> None:
        """Open the buses. Nothing is requested from a module yet.

        Args:
            config: the run, with the robot.
            settings: settings of the backend.
            clock: time of the driver.
            pose: address, HOST:PORT, to which emulators of this driver send motion capture; None: nowhere.
            readings: gets the serial number and the firmware version of every module.

        Raises:
            ConfigError: the settings are impossible.
            BackendError: a bus cannot be opened, or the emulators cannot be started.
        """
        # Configuration.
        self._config = config
        self._settings = settings
        self._clock = clock
        self._readings = readings
        self._lockstep = config.clock_mode == "lockstep"
        self._reports = plan_reports(config, settings)
        self._names = [joint.name for joint in config.robot.joint_table]

        # Modules.
        self.reading = ModuleReports(len(self._names))
        self._setpoints = commands.SetpointWriter(len(self._names))
        self._unconfigured = set(range(len(self._names)))  # joints whose parameters may differ from the robot file
        # Whether no other host uses the modules: before that is known, nothing that disturbs them is sent.
        self._is_only_host = False

        # Lifecycle.
        self._lifecycle: LifecycleState = "disarmed"
        self._isolated: frozenset[int] = frozenset()  # isolated joints: motors off, and no setpoints
        self._arm_session = ArmSession()
        self._arm_is_due = False  # whether the lifecycle became armed in this cycle
        self._all_cleared = False  # whether the lifecycle left a latched state in this cycle

        # Buses.
        self.wires: list[Wire] = []
        self.local_emulators: VirtualPeer | None = None
        self._emulators: EmulatorProcess | None = None
        self._unsent: list[str] = []  # channels that rejected a frame in this cycle
        self._answer_limit_s = LOCKSTEP_ANSWER_S if self._lockstep else FIRST_STATE_PAUSE_S
        try:
            self._buses = self._open_buses(joints_per_bus(config, settings), pose)
        except BaseException:
            self.close()
            raise
        self._wire_of = [bus.wire for bus in self._buses for _ in bus.nodes]  # by joint
        channels = [wire.channel for wire in self._wire_of]
        self.monitor = ModuleMonitor(self._names, channels, config.period_ns * 1e-9)

    # --- Drives -----------------------------------------------------------------------------------------------

    def bring_up(self) -> None:
        """Find every module, check it, and write its parameters; nothing is enabled.

        Raises:
            BackendError: a module is missing or wrong, or another host commands the modules.
        """
        limit_s = self._settings.bring_up_limit_s
        identities = find_modules(self._buses, limit_s, self.reading.process_frame)
        if self.reading.from_other_host:
            raise BackendError(
                "another program commands the modules on this bus; end it first. Nothing was sent",
                code="bus/second-host",
            )
        errors = discovery_errors(self._buses, identities, self._names, lockstep=self._lockstep)
        if errors:
            raise BackendError(
                "the robot is not complete; nothing was enabled:",
                *(f"  {error}" for error in errors),
                code="drive/not-complete",
            )
        self._is_only_host = True
        self.emulated = all(identity.emulated for identity in identities)
        for identity in identities:
            joint = identity.node - 1
            self._readings.set_identity(joint, serial=f"{identity.serial:08X}", firmware=identity.firmware)
        self._broadcast(commands.make_command(CommandAction.DISARM))
        self._configure(limit_s)
        self._await_first_states()
        self._clear_faults_of_killed_driver()
        self._answer_limit_s = answer_limit_s(self._config, self._settings)

    def read(self) -> None:
        """Send a Sync, at which all modules sample their sensors, and collect their answers for a limited time.

        A module that does not answer in time keeps its last values.
        """
        reading = self.reading
        queries = self._lockstep_queries()
        time_us = self._clock.now_ns() // 1000
        self._receive()
        sync = reading.sync + 1
        contacts = contacts_due(self._reports, sync)
        reading.begin_sync(sync, contacts=contacts, tail=self._reports.tail, questions=len(queries))
        frame = commands.make_sync(sync, time_us)
        self._unsent = [wire.channel for wire in self.wires if not wire.send(frame)]
        for wire, query in queries:
            wire.send(query)
        if reading.complete:  # no answer is expected; but emulators in this process run only while this one waits
            wait(self.wires, 0.0)
        deadline_s = time.monotonic() + self._answer_limit_s
        while not reading.complete:
            left_s = deadline_s - time.monotonic()
            if left_s <= 0 or not wait(self.wires, left_s):
                break
            self._receive()

    def announce(self, lifecycle: LifecycleState, isolated: frozenset[int]) -> None:
        """Send the commands that follow from the robot's lifecycle, except Arm, which `send_setpoints` sends.

        Call it before anything else in a cycle, because the rest may take a while. Modules that missed an earlier
        command get it again.

        Args:
            lifecycle: state of the robot in this cycle.
            isolated: joints whose modules are disarmed and get no setpoints.
        """
        before = self._lifecycle
        self._lifecycle = lifecycle
        if lifecycle == before:
            self._repeat_missed_commands(lifecycle)
        elif lifecycle == "armed":
            self._arm_session = ArmSession(self.reading.sync)

        frames = commands.make_transition_frames(before, lifecycle)
        self._arm_is_due = any(commands.is_arm_command(frame) for frame in frames)
        self._all_cleared = before in commands.LATCHED
        for frame in frames:
            if not commands.is_arm_command(frame):
                self._broadcast(frame)

        newly_isolated = isolated - self._isolated
        self._isolated = isolated
        for joint in sorted(newly_isolated):
            self._send_command(CommandAction.DISARM, joint)

    def reset_faults(self, joints: frozenset[int]) -> None:
        """Clear the faults of some joints' modules, and configure modules whose parameters may have changed.

        They are configured once, while motors are off. A module that does not accept its parameters then is reported
        as a fault, and nothing is armed.
        """
        self.monitor.reset(self.reading.sync)
        if not self._all_cleared:  # otherwise `announce` has sent a Clear to all modules
            for joint in sorted(joints):
                self._send_command(CommandAction.CLEAR, joint)
        if self._unconfigured:
            try:
                self._configure(CONFIGURE_LIMIT_S)
            except BackendError as error:
                _log.warning("after a clear: %s", error)

    def send_setpoints(self, command: BusCommand) -> None:
        """Send the setpoints while the robot is armed. Otherwise send none, and the modules come to rest by themselves.

        Args:
            command: setpoints of all joints, and which of them follow. `may_enable` and `emergency` are not used,
                because `announce` arms, disarms and stops modules.
        """
        must_not_arm = self._unconfigured - self._isolated
        if self._arm_is_due and not must_not_arm:
            self._arm()
        self._arm_is_due = False
        if self._lifecycle != "armed":
            return
        for joint, frame in enumerate(self._setpoints.encode(command.modes, command.targets, command.limits_nm)):
            if joint not in command.following:
                continue
            wire = self._wire_of[joint]
            if wire.send(frame):
                self._setpoints.confirm_sent(joint)
            else:  # the queue is full or the interface down: the next setpoint replaces this one
                self._unsent.append(wire.channel)

    def findings(self) -> list[Finding]:
        """Return the new faults that modules and buses report, or that the monitor detects."""
        errors = [error for wire in self.wires for error in wire.errors()]
        findings = self.monitor.find_faults(
            self.reading, self._lifecycle, errors, self._unsent, self._unconfigured, self._isolated
        )
        self._unconfigured |= self.monitor.take_changed()
        return findings

    def poll(self) -> None:
        """Process the frames that have arrived meanwhile.

        Raises:
            BackendError: the emulators of this driver have ended.
        """
        if self._emulators is not None:
            ended = self._emulators.describe_exit()
            if ended is not None:
                raise BackendError(ended)
        self._receive()

    def inject(self, injection: Injection, *, begins: bool) -> bool:
        """Begin or end a fault of a bus or of an emulated module of this driver.

        Returns:
            False for a fault of something else.

        Raises:
            ConfigError: there is no such bus or joint.
        """
        if inject_into(self.wires, injection, begins=begins):
            return True
        emulators = self._emulators or self.local_emulators
        if emulators is None or not supports_fault(injection, len(self._wire_of)):
            return False
        emulators.inject(injection, begins=begins)
        return True

    def close(self) -> None:
        """Switch the motors off, close the buses, and end the emulators of this driver."""
        for wire in self.wires:
            self._close_wire(wire)
        if self._emulators is not None:
            self._emulators.stop()

    # --- opening and closing ----------------------------------------------------------------------------------

    def _open_buses(self, joints_of_buses: list[int], pose: str | None) -> list[ModuleBus]:
        """Open every bus, and start the emulators if the settings ask for them.

        Args:
            joints_of_buses: number of joints on each bus, tail to head.
            pose: address, HOST:PORT, to which emulators send motion capture; None: nowhere.

        Returns:
            The buses, with the nodes that are expected on each of them.
        """
        settings = self._settings
        if settings.emulators_run == "process":
            self._emulators = EmulatorProcess(self._config, settings, pose, stepped=self._lockstep)
        if settings.channels:
            for channel in settings.channels:
                self.wires.append(open_wire(channel, bit_rate=settings.bit_rate))
        else:
            channel = make_virtual_channel()
            self.local_emulators = start_local_emulators(self._config, settings, channel, pose, stepped=self._lockstep)
            self.wires.append(VirtualWire(channel, self.local_emulators))
        if settings.log:
            log = open_log(Path(settings.log))
            self.wires = [LoggedWire(wire, log) for wire in self.wires]
        buses: list[ModuleBus] = []
        first_node = 1
        for wire, joints in zip(self.wires, joints_of_buses, strict=True):
            buses.append(ModuleBus(wire, range(first_node, first_node + joints)))
            first_node += joints
        return buses

    def _close_wire(self, wire: Wire) -> None:
        """Switch motors off and close a bus, as far as it still works. An error does not keep other buses open."""
        try:
            if self._is_only_host:
                wire.send(commands.make_command(CommandAction.DISARM))
            wire.idle()
        except BackendError as error:
            _log.warning("closing: %s", error)
        try:
            wire.close()
        except BackendError as error:
            _log.warning("closing: %s", error)

    def _configure(self, limit_s: float) -> None:
        """Write the parameters of every module that needs them. Raises BackendError."""
        planned = plan_parameters(self._config.robot, self._settings, self._reports)
        due = {joint + 1: planned[joint + 1] for joint in self._unconfigured}
        try:
            in_force = configure_modules(self._buses, due, limit_s, self.reading.process_frame)
            check_ratings(self._config.robot, in_force)
        finally:
            self.reading.reset_frame_counts()  # the frames arrived over more than one period
        self._unconfigured.clear()

    def _await_first_states(self) -> None:
        """Send Syncs until every module has answered one. Raises BackendError."""
        for _ in range(FIRST_STATE_SYNCS):
            self.read()
            if all(module.sync >= 0 for module in self.reading.modules):
                self.reading.unknown_nodes.clear()
                return
        modules = zip(self._names, self.reading.modules, strict=True)
        silent = [name for name, module in modules if module.sync < 0]
        raise BackendError(
            f"{', '.join(silent)} did not answer {FIRST_STATE_SYNCS} Syncs; nothing was enabled", code="drive/silent"
        )

    def _clear_faults_of_killed_driver(self) -> None:
        """Clear the faults that a killed driver has left; but not heat, leaks and emergencies."""
        for _ in range(FIRST_STATE_SYNCS):  # the reason of a fault comes in a later heartbeat
            if all(module.faults or module.state != ModuleState.FAULT for module in self.reading.modules):
                break
            time.sleep(FIRST_STATE_PAUSE_S)
            self.read()
        for joint, module in enumerate(self.reading.modules):
            faults = module.fault_names()
            has_only_such_faults = bool(faults) and set(faults) <= FAULTS_OF_KILLED_DRIVER
            if module.state == ModuleState.FAULT and has_only_such_faults:
                _log.warning("node %d: clearing an earlier fault: %s", module.node, ", ".join(faults))
                self._send_command(CommandAction.CLEAR, joint)

    # --- receiving --------------------------------------------------------------------------------------------

    def _receive(self) -> None:
        process_frame = self.reading.process_frame
        for wire in self.wires:
            for frame in wire.receive():
                process_frame(frame)

    def _lockstep_queries(self) -> list[tuple[Wire, Frame]]:
        """Return one query for each bus of emulators in lockstep, to be sent after the next Sync.

        Some reports come only at some Syncs, so that a missing one might still be on its way. Once a query is answered,
        all earlier frames have arrived.
        """
        if self._emulators is None or not self._lockstep:
            return []
        queries: dict[str, tuple[Wire, Frame]] = {}
        for module, wire in zip(self.reading.modules, self._wire_of, strict=True):
            answered_newest_sync = module.sync >= 0 and module.sync == self.reading.sync
            if answered_newest_sync:
                queries.setdefault(wire.channel, (wire, commands.make_query(module.node)))
        return list(queries.values())

    # --- sending ----------------------------------------------------------------------------------------------

    def _send_command(self, action: CommandAction, joint: int) -> None:
        self._wire_of[joint].send(commands.make_command(action, joint + 1))

    def _broadcast(self, frame: Frame) -> None:
        """Send a frame to all buses; an error of one does not prevent sending on the others."""
        failure: BackendError | None = None
        for wire in self.wires:
            try:
                wire.send(frame)
            except BackendError as error:
                failure = error
        if failure is not None:
            raise failure

    def _arm(self) -> None:
        """Send Arm to all modules, except isolated ones."""
        if not self._isolated:
            self._broadcast(commands.make_command(CommandAction.ARM))
            return
        for joint in range(len(self._wire_of)):
            if joint not in self._isolated:
                self._send_command(CommandAction.ARM, joint)

    def _repeat_missed_commands(self, lifecycle: LifecycleState) -> None:
        """Repeat a command to every module that is not in the state that the lifecycle demands."""
        for joint, module in enumerate(self.reading.modules):
            if lifecycle == "armed":
                self._repeat_while_armed(joint, module)
            else:
                self._send_reminder(lifecycle, joint, module)

    def _repeat_while_armed(self, joint: int, module: ModuleStatus) -> None:
        """Disarm an isolated module, and arm any other that missed the Arm of this session.

        A module that was armed in this session, and no longer is, has been stopped: it is not armed again.
        """
        if joint in self._isolated:
            if module.state in (ModuleState.ARMED, ModuleState.STOPPING):
                self._send_command(CommandAction.DISARM, joint)
            return
        session = self._arm_session
        if module.state == ModuleState.ARMED:
            session.armed_joints.add(joint)
        in_time = self.reading.sync - session.sync <= ARM_GRACE
        must_not_arm = self._unconfigured - self._isolated
        if in_time and not must_not_arm and joint not in session.armed_joints:
            self._send_reminder("armed", joint, module)

    def _send_reminder(self, lifecycle: LifecycleState, joint: int, module: ModuleStatus) -> None:
        frame = commands.make_reminder(lifecycle, module.state, module.node)
        if frame is not None:
            self._wire_of[joint].send(frame)


def answer_limit_s(config: RunConfig, settings: CanSettings) -> float:
    """Return how long all answers to a Sync may take on the fullest bus; the rest of a period is for the controller."""
    if config.clock_mode == "lockstep":
        return LOCKSTEP_ANSWER_S
    reports = plan_reports(config, settings)
    frames_per_joint = 1 + (reports.contact_every > 0)
    frames = max(joints_per_bus(config, settings)) * frames_per_joint + reports.tail
    bus_s = frames * worst_frame_bits(FRAME_BYTES) / reports.bit_rate
    return min(ANSWER_MARGIN * bus_s + ANSWER_SLACK_S, MAX_OF_PERIOD / reports.rate_hz)
