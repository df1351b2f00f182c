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
from snakesim_can_backend.bus.bus import (
    VirtualPeer,
    VirtualWire,
    Wire,
    inject_into,
    make_virtual_channel,
    wait,
)
from snakesim_can_backend.bus.load import compute_max_frame_bits, count_joints_per_bus, plan_reports
from snakesim_can_backend.bus.log import LoggedWire, open_log
from snakesim_can_backend.driver.bring_up import (
    ModuleBus,
    configure_modules,
    find_discovery_errors,
    find_modules,
)
from snakesim_can_backend.driver.firmware_process import FirmwareProcess
from snakesim_can_backend.driver.module_monitor import ARM_GRACE_SYNCS, ModuleMonitor
from snakesim_can_backend.driver.own_emulators import (
    EmulatorProcess,
    start_in_process_emulators,
    supports_fault,
)
from snakesim_can_backend.driver.parameters import plan_parameters, validate_ratings
from snakesim_can_backend.driver.reports import ModuleReports, ModuleStatus
from snakesim_can_backend.driver.sensors import are_contacts_due
from snakesim_can_backend.protocol import commands
from snakesim_can_backend.protocol.definitions import CanFrame, CommandAction, ModuleState
from snakesim_can_backend.settings import CanSettings
from snakesim_drivers.kit.drive_backend import DriverClock
from snakesim_drivers.kit.drives import BusCommand, Drives
from snakesim_drivers.kit.findings import FaultFinding
from snakesim_drivers.kit.readings import DriveReadings
from snakesim_hal.base.errors import BackendError
from snakesim_hal.model.fault_kinds import FaultInjection
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.wire.messages import LifecycleState

RESPONSE_TIME_FACTOR = 1.25  # on the bus time that all answers take
RESPONSE_LATENCY_S = 0.002  # latency of the adapter and of this process
MAX_RESPONSE_PERIOD_FRACTION = 0.75  # the rest of a period is for the controller
# While the robot is up; an emergency stop waits no longer than that, with motors off.
CONFIGURE_TIMEOUT_S = 1.0
LOCKSTEP_RESPONSE_TIMEOUT_S = 2.0  # to wait for slow emulators; dead ones are not waited for again
FIRST_STATE_SYNCS = 20  # within which every module must send its first state
FIRST_STATE_PAUSE_S = 0.02
# Of a module whose driver ended without disarming it.
FAULTS_OF_KILLED_DRIVER = {"watchdog", "stream"}
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
        self,
        config: RunConfig,
        settings: CanSettings,
        clock: DriverClock,
        pose_address: str | None,
        readings: DriveReadings,
    ) -> None:
        """Open the buses. Nothing is requested from a module yet.

        Args:
            config: Configuration of the run, with the robot.
            settings: Settings of the backend.
            clock: Clock of the driver.
            pose_address: HOST:PORT to which emulators of this driver send motion capture; None if they do not send.
            readings: Object that stores the serial number and the firmware version of every module.

        Raises:
            ConfigError: The joints do not fit on the buses, or the log cannot be written.
            BackendError: A bus cannot be opened, or the emulators cannot be started.
        """
        # Configuration.
        self._config = config
        self._settings = settings
        self._clock = clock
        self._readings = readings
        self._lockstep = config.clock_mode == "lockstep"
        self._reports = plan_reports(config, settings)
        self._joint_names = [joint.name for joint in config.robot.joint_table]

        # Modules.
        self.module_reports = ModuleReports(len(self._joint_names))
        self._setpoints = commands.SetpointWriter(len(self._joint_names))
        # Joints whose parameters may differ from the robot file.
        self._unconfigured_joints = set(range(len(self._joint_names)))
        # Whether no other host uses the modules: before that is known, nothing that disturbs them is sent.
        self._is_only_host = False

        # Lifecycle.
        self._lifecycle: LifecycleState = "disarmed"
        # Isolated joints: motors off, and no setpoints.
        self._isolated_joints: frozenset[int] = frozenset()
        self._arm_session = ArmSession()
        self._is_arm_due = False  # whether the lifecycle became armed in this cycle
        # Whether the lifecycle left a latched state in this cycle.
        self._was_clear_broadcast = False

        # Buses.
        self.wires: list[Wire] = []
        self.local_emulators: VirtualPeer | None = None
        self._emulator_process: EmulatorProcess | None = None
        self._rejecting_channels: list[str] = []  # channels that rejected a frame in this cycle
        self._response_timeout_s = (
            LOCKSTEP_RESPONSE_TIMEOUT_S if self._lockstep else FIRST_STATE_PAUSE_S
        )
        try:
            self._buses = self._open_buses(count_joints_per_bus(config, settings), pose_address)
        except BaseException:
            self.close()
            raise
        self._wire_by_joint = [bus.wire for bus in self._buses for _ in bus.node_ids]  # by joint
        channels = [wire.channel for wire in self._wire_by_joint]
        self.monitor = ModuleMonitor(self._joint_names, channels, config.period_ns * 1e-9)

    # --- Drives -----------------------------------------------------------------------------------------------

    def bring_up(self) -> None:
        """Find every module, check it, write its parameters, and wait for its first joint state; nothing is enabled.

        Faults that a killed driver has left are cleared.

        Raises:
            BackendError: A module is missing or wrong, or another host commands the modules.
        """
        timeout_s = self._settings.bring_up_limit_s
        identities = find_modules(self._buses, timeout_s, self.module_reports.process_frame)
        if self.module_reports.other_host_frame_counts:
            raise BackendError(
                "another program commands the modules on this bus; end it first. Nothing was sent",
                code="bus/second-host",
            )
        errors = find_discovery_errors(
            self._buses, identities, self._joint_names, is_lockstep=self._lockstep
        )
        if errors:
            raise BackendError(
                "the robot is not complete; nothing was enabled:",
                *(f"  {error}" for error in errors),
                code="drive/not-complete",
            )
        self._is_only_host = True
        self.emulated = all(identity.is_emulated for identity in identities)
        for identity in identities:
            joint = identity.node_id - 1
            self._readings.set_identity(
                joint, serial=f"{identity.serial:08X}", firmware=identity.firmware
            )
        self._broadcast(commands.make_command(CommandAction.DISARM))
        self._configure_modules(timeout_s)
        self._wait_for_first_states()
        self._clear_faults_of_killed_driver()
        self._response_timeout_s = compute_response_timeout_s(self._config, self._settings)

    def read(self) -> None:
        """Send a Sync, at which all modules sample their sensors, and receive their responses until a timeout.

        A module that does not respond in time keeps its last values.
        """
        module_reports = self.module_reports
        queries = self._make_lockstep_queries()
        time_us = self._clock.now_ns() // 1000
        self._receive()
        sync = module_reports.sync + 1
        contacts = are_contacts_due(self._reports, sync)
        module_reports.start_sync(
            sync,
            has_contacts=contacts,
            has_tail_contact=self._reports.tail,
            query_count=len(queries),
        )
        frame = commands.make_sync(sync, time_us)
        self._rejecting_channels = [wire.channel for wire in self.wires if not wire.send(frame)]
        for wire, query in queries:
            wire.send(query)
        # No response is expected; but emulators in this process run only in `wait`.
        if module_reports.is_complete:
            wait(self.wires, 0.0)
        is_every_bus_queried = len(queries) == len(self.wires)
        deadline_s = time.monotonic() + self._response_timeout_s
        while not module_reports.is_complete:
            if is_every_bus_queried and module_reports.answers_missing <= 0:
                break  # all earlier frames have arrived, and a module that has not answered will not
            remaining_s = deadline_s - time.monotonic()
            if remaining_s <= 0 or not wait(self.wires, remaining_s):
                break
            self._receive()

    def send_lifecycle_commands(self, lifecycle: LifecycleState, isolated: frozenset[int]) -> None:
        """Send the commands that a change of the robot's lifecycle state requires, except Arm.

        `send_setpoints` sends Arm later in the same cycle. Call this method before anything else in a cycle, because
        the rest may take a while. Modules that missed an earlier command get it again.

        Args:
            lifecycle: Lifecycle state of the robot in this cycle.
            isolated: Joints whose modules are disarmed and get no setpoints.
        """
        previous_lifecycle = self._lifecycle
        self._lifecycle = lifecycle
        if lifecycle == previous_lifecycle:
            self._repeat_missed_commands(lifecycle)
        elif lifecycle == "armed":
            self._arm_session = ArmSession(self.module_reports.sync)

        frames = commands.make_transition_frames(previous_lifecycle, lifecycle)
        self._is_arm_due = any(commands.is_arm_command(frame) for frame in frames)
        self._was_clear_broadcast = previous_lifecycle in commands.LATCHED_LIFECYCLE_STATES
        for frame in frames:
            if not commands.is_arm_command(frame):
                self._broadcast(frame)

        newly_isolated = isolated - self._isolated_joints
        self._isolated_joints = isolated
        for joint in sorted(newly_isolated):
            self._send_command(CommandAction.DISARM, joint)

    def reset_faults(self, joints: frozenset[int]) -> None:
        """Clear the faults of some joints' modules, and configure modules whose parameters may have changed.

        Modules are configured while motors are off. A module that does not accept its parameters is reported as a
        fault, and nothing is armed.

        Args:
            joints: Indices of the joints whose faults the operator has reset.
        """
        self.monitor.reset(self.module_reports.sync)
        # Otherwise `send_lifecycle_commands` has sent a Clear to all modules.
        if not self._was_clear_broadcast:
            for joint in sorted(joints):
                self._send_command(CommandAction.CLEAR, joint)
        if self._unconfigured_joints:
            try:
                self._configure_modules(CONFIGURE_TIMEOUT_S)
            except BackendError as error:
                _log.warning("after a clear: %s", error)

    def send_setpoints(self, command: BusCommand) -> None:
        """Send Arm if it is due, and setpoints while the robot is armed.

        Without setpoints the modules come to rest by themselves.

        Args:
            command: Setpoints of all joints, and which are enabled. `may_enable` and `emergency` are not used,
                because `send_lifecycle_commands` arms, disarms and stops modules.
        """
        unconfigured_joints = self._unconfigured_joints - self._isolated_joints
        if self._is_arm_due and not unconfigured_joints:
            self._send_arm()
        self._is_arm_due = False
        if self._lifecycle != "armed":
            return
        for joint, frame in enumerate(
            self._setpoints.encode(command.modes, command.targets, command.limits_nm)
        ):
            if joint not in command.enabled_drives:
                continue
            wire = self._wire_by_joint[joint]
            if wire.send(frame):
                self._setpoints.confirm_sent(joint)
            else:  # the queue is full or the interface down: the next setpoint replaces this one
                self._rejecting_channels.append(wire.channel)

    def list_findings(self) -> list[FaultFinding]:
        """Return the new faults that modules and buses report, or that the monitor detects."""
        errors = [error for wire in self.wires for error in wire.errors()]
        findings = self.monitor.find_faults(
            self.module_reports,
            self._lifecycle,
            errors,
            self._rejecting_channels,
            self._unconfigured_joints,
            self._isolated_joints,
        )
        self._unconfigured_joints |= self.monitor.pop_changed_joints()
        return findings

    def poll(self) -> None:
        """Process the frames that have arrived meanwhile.

        Raises:
            BackendError: The emulators of this driver have ended.
        """
        if self._emulator_process is not None:
            ended = self._emulator_process.describe_exit()
            if ended is not None:
                raise BackendError(ended)
        self._receive()

    def inject(self, injection: FaultInjection, *, begins: bool) -> bool:
        """Start or end an injected fault of a bus or of an emulated module of this driver.

        Returns:
            True if the fault was started or ended; False for a fault of something else.

        Raises:
            ConfigError: There is no such bus or joint.
        """
        if inject_into(self.wires, injection, begins=begins):
            return True
        emulators = self._emulator_process or self.local_emulators
        if emulators is None or not supports_fault(injection, len(self._wire_by_joint)):
            return False
        emulators.inject(injection, begins=begins)
        return True

    def close(self) -> None:
        """Switch the motors off, close the buses, and end the emulators of this driver."""
        for wire in self.wires:
            self._close_wire(wire)
        if self._emulator_process is not None:
            self._emulator_process.stop()

    # --- opening and closing ----------------------------------------------------------------------------------

    def _open_buses(self, joint_counts: list[int], pose_address: str | None) -> list[ModuleBus]:
        """Open every bus, and start the emulators if the settings ask for them.

        The open buses are stored in `wires` at once, so that `close` closes them after an error, too.

        Args:
            joint_counts: Number of joints on each bus, from tail to head.
            pose_address: HOST:PORT to which emulators send motion capture; None if they do not send.

        Returns:
            The buses, with the nodes that are expected on each of them.
        """
        settings = self._settings
        channels = settings.channels
        if settings.emulators_run == "process":
            self._emulator_process = EmulatorProcess(
                self._config, settings, pose_address, is_stepped=self._lockstep
            )
        if settings.emulators_run == "firmware":
            firmware_process = FirmwareProcess(self._config, settings, is_stepped=self._lockstep)
            self._emulator_process = firmware_process
            channels = [firmware_process.channel]
        if channels:
            for channel in channels:
                self.wires.append(open_wire(channel, bit_rate=settings.bit_rate))
        else:
            channel = make_virtual_channel()
            self.local_emulators = start_in_process_emulators(
                self._config, settings, channel, pose_address, is_stepped=self._lockstep
            )
            self.wires.append(VirtualWire(channel, self.local_emulators))
        if settings.log:
            log = open_log(Path(settings.log))
            self.wires = [LoggedWire(wire, log) for wire in self.wires]
        buses: list[ModuleBus] = []
        first_node = 1  # node ids count from 1, from tail to head over all buses
        for wire, joints in zip(self.wires, joint_counts, strict=True):
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

    def _configure_modules(self, timeout_s: float) -> None:
        """Write the parameters of every module that needs them. Raises BackendError."""
        parameters_by_node = plan_parameters(self._config.robot, self._settings, self._reports)
        due = {joint + 1: parameters_by_node[joint + 1] for joint in self._unconfigured_joints}
        try:
            current_values = configure_modules(
                self._buses, due, timeout_s, self.module_reports.process_frame
            )
            validate_ratings(self._config.robot, current_values)
        finally:
            self.module_reports.reset_frame_counts()  # the frames arrived over more than one period
        self._unconfigured_joints.clear()

    def _wait_for_first_states(self) -> None:
        """Send Syncs until every module has answered one. Raises BackendError."""
        for _ in range(FIRST_STATE_SYNCS):
            self.read()
            if all(module.sync >= 0 for module in self.module_reports.modules):
                self.module_reports.unknown_node_frame_counts.clear()
                return
        modules = zip(self._joint_names, self.module_reports.modules, strict=True)
        silent = [name for name, module in modules if module.sync < 0]
        raise BackendError(
            f"{', '.join(silent)} did not answer {FIRST_STATE_SYNCS} Syncs; nothing was enabled",
            code="drive/silent",
        )

    def _clear_faults_of_killed_driver(self) -> None:
        """Clear the faults that a killed driver has left; but not heat, leaks and emergencies."""
        for _ in range(FIRST_STATE_SYNCS):  # the reason of a fault comes in a later heartbeat
            if all(
                module.faults or module.state != ModuleState.FAULT
                for module in self.module_reports.modules
            ):
                break
            time.sleep(FIRST_STATE_PAUSE_S)
            self.read()
        for joint, module in enumerate(self.module_reports.modules):
            faults = module.list_fault_names()
            has_only_such_faults = bool(faults) and set(faults) <= FAULTS_OF_KILLED_DRIVER
            if module.state == ModuleState.FAULT and has_only_such_faults:
                _log.warning(
                    "node %d: clearing an earlier fault: %s", module.node_id, ", ".join(faults)
                )
                self._send_command(CommandAction.CLEAR, joint)

    # --- receiving --------------------------------------------------------------------------------------------

    def _receive(self) -> None:
        process_frame = self.module_reports.process_frame
        for wire in self.wires:
            for frame in wire.receive():
                process_frame(frame)

    def _make_lockstep_queries(self) -> list[tuple[Wire, CanFrame]]:
        """Return one query for each bus of emulators in lockstep, to be sent after the next Sync.

        Some reports come only at some Syncs, so that a missing one might still be on its way. Once a query is answered,
        all earlier frames have arrived.
        """
        if self._emulator_process is None or not self._lockstep:
            return []
        queries: dict[str, tuple[Wire, CanFrame]] = {}
        for module, wire in zip(self.module_reports.modules, self._wire_by_joint, strict=True):
            answered_newest_sync = module.sync >= 0 and module.sync == self.module_reports.sync
            if answered_newest_sync:
                queries.setdefault(wire.channel, (wire, commands.make_query(module.node_id)))
        return list(queries.values())

    # --- sending ----------------------------------------------------------------------------------------------

    def _send_command(self, action: CommandAction, joint_index: int) -> None:
        self._wire_by_joint[joint_index].send(commands.make_command(action, joint_index + 1))

    def _broadcast(self, frame: CanFrame) -> None:
        """Send a frame to all buses; an error of one does not prevent sending on the others."""
        failure: BackendError | None = None
        for wire in self.wires:
            try:
                wire.send(frame)
            except BackendError as error:
                failure = error
        if failure is not None:
            raise failure

    def _send_arm(self) -> None:
        """Send Arm to all modules, except isolated ones."""
        if not self._isolated_joints:
            self._broadcast(commands.make_command(CommandAction.ARM))
            return
        for joint in range(len(self._wire_by_joint)):
            if joint not in self._isolated_joints:
                self._send_command(CommandAction.ARM, joint)

    def _repeat_missed_commands(self, lifecycle: LifecycleState) -> None:
        """Repeat a command to every module that is not in the state that the lifecycle demands."""
        for joint, module in enumerate(self.module_reports.modules):
            if lifecycle == "armed":
                self._repeat_arm_or_disarm(joint, module)
            else:
                self._repeat_command(lifecycle, joint, module)

    def _repeat_arm_or_disarm(self, joint_index: int, module: ModuleStatus) -> None:
        """Disarm an isolated module, and arm any other that missed the Arm of this session.

        A module that was armed in this session, and no longer is, has been stopped: it is not armed again.
        """
        if joint_index in self._isolated_joints:
            if module.state in (ModuleState.ARMED, ModuleState.STOPPING):
                self._send_command(CommandAction.DISARM, joint_index)
            return
        session = self._arm_session
        if module.state == ModuleState.ARMED:
            session.armed_joints.add(joint_index)
        in_time = self.module_reports.sync - session.sync <= ARM_GRACE_SYNCS
        unconfigured_joints = self._unconfigured_joints - self._isolated_joints
        if in_time and not unconfigured_joints and joint_index not in session.armed_joints:
            self._repeat_command("armed", joint_index, module)

    def _repeat_command(
        self, lifecycle: LifecycleState, joint_index: int, module: ModuleStatus
    ) -> None:
        frame = commands.make_repeated_command(lifecycle, module.state, module.node_id)
        if frame is not None:
            self._wire_by_joint[joint_index].send(frame)


def compute_response_timeout_s(config: RunConfig, settings: CanSettings) -> float:
    """Return how long the driver waits for all responses to a Sync, in s.

    This is the bus time of all responses on the bus with the most joints, with a margin. The rest of a control period
    is for the controller. In lockstep the wait is long, because emulators may be slow.
    """
    if config.clock_mode == "lockstep":
        return LOCKSTEP_RESPONSE_TIMEOUT_S
    reports = plan_reports(config, settings)
    frames_per_joint = 1 + (reports.contact_every > 0)
    frames = max(count_joints_per_bus(config, settings)) * frames_per_joint + reports.tail
    bus_time_s = frames * compute_max_frame_bits(FRAME_BYTES) / reports.bit_rate
    return min(
        RESPONSE_TIME_FACTOR * bus_time_s + RESPONSE_LATENCY_S,
        MAX_RESPONSE_PERIOD_FRACTION / reports.rate_hz,
    )
