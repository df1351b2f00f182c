"""The firmware of one joint module, as a state machine: frames and time in, frames and a motor demand out.

    BOOT -> DISARMED -> ARMED -> STOPPING -> DISARMED
               ^          |         |
               +-- clear -- FAULT <-+          EMERGENCY from everywhere, left by clear only

Only ARMED and STOPPING drive the motor. Only a valid setpoint feeds the watchdog. Times are microseconds on one clock
and are passed in; nothing here waits. `frames` collects the frames to send, and the caller empties it.
"""

from typing import NamedTuple

from snakesim_can_backend.emulator.frames import (
    LENGTHS,
    TARGET_STEPS,
    TORQUE_LIMIT_STEP_NM,
    EmulatedHealth,
    ModuleReadings,
    encode_health,
    read_command,
    read_setpoint,
    write_acceleration,
    write_contact,
    write_gyro,
    write_health,
    write_heartbeat,
    write_identity,
    write_joint_state,
    write_shaft_load,
    write_tail_contact,
)
from snakesim_can_backend.emulator.parameters import ParameterStore
from snakesim_can_backend.protocol.definitions import (
    COMMAND_KEY,
    COUNTER_MODULUS,
    HEALTH_PERIOD_S,
    HEARTBEAT_PERIOD_S,
    MAX_LOST_SETPOINTS,
    MAX_UPTIME_MS,
    MAX_WRONG_COUNTS,
    PROTOCOL_VERSION,
    CanFrame,
    CommandAction,
    LastStop,
    ModuleFault,
    ModuleParameter,
    ModuleState,
    Opcode,
    SafeMotion,
    has_valid_checksum,
    parse_opcode,
)
from snakesim_hal.physics.thermal import HeatLimits
from snakesim_hal.wire.messages import JointMode

BOOT_US = 100_000
HEARTBEAT_US = round(HEARTBEAT_PERIOD_S * 1e6)
HEALTH_US = round(HEALTH_PERIOD_S * 1e6)
HEALTH_PHASES = 16  # modules send their first Health at different times, so that the bus is not busy all at once
AT_REST_RAD_S = 0.05  # a slower joint has come to rest, and STOPPING ends
FIRMWARE_VERSION = (1, 0)  # major, minor
IS_EMULATED = 1  # the bit of Identity that a real module does not set
MODES = tuple(JointMode)
STOP_OF_FAULT = {fault: LastStop[fault.name] for fault in ModuleFault}
DRIVEN_STATES = (ModuleState.ARMED, ModuleState.STOPPING)
LATCHED_STATES = (ModuleState.FAULT, ModuleState.EMERGENCY)


class MotorDemand(NamedTuple):
    """What the firmware demands of its motor."""

    mode: JointMode
    target: float  # rad, rad/s or N·m, depending on the mode
    torque_limit_nm: float


PASSIVE = MotorDemand(JointMode.PASSIVE, 0.0, 0.0)


class ModuleFirmware:
    """The firmware of one module on the bus."""

    def __init__(
        self,
        node_id: int,
        serial: int,
        parameters: ParameterStore,
        heat: HeatLimits,
        *,
        min_voltage_v: float = 18.0,
        is_stepped: bool = False,
        now_us: float = 0.0,
    ) -> None:
        """Create the firmware of one emulated module, in its state BOOT. `poll` ends the boot after BOOT_US.

        Args:
            node_id: Node id of the module on its bus.
            serial: Serial number, reported in Identity.
            parameters: Parameters of the module, and its flash.
            heat: Winding temperature that stops the module, and the one below which a clear is possible again.
            min_voltage_v: Supply voltage below which the module stops.
            is_stepped: Whether time advances only from Sync to Sync; reported in Identity.
            now_us: Current time.
        """
        # What the module is.
        self.node_id = node_id
        self.serial = serial
        self.parameters = parameters
        self.heat = heat
        self._min_voltage_v = min_voltage_v
        self._is_stepped = is_stepped

        # What the caller exchanges with it.
        self.frames: list[CanFrame] = []  # to send
        self.health = EmulatedHealth()  # present internal measurements
        # Whether the main loop hangs, so that only the hardware still works.
        self.is_hanging = False
        self.rejected_frame_count = 0  # frames with a wrong checksum, count or length

        self._last_joint_state: CanFrame | None = None  # JointState frame that was sent last
        self._reset_state(now_us)
        # Not part of `_reset_state`: `reboot` sets another reason.
        self.last_stop = LastStop.NONE

    # --- frames from the bus -------------------------------------------------------------------------------

    def receive(self, frame: CanFrame, now_us: float) -> None:
        """Process an Emergency, Command or ParameterRequest. The first two may be broadcasts.

        A module that boots executes only an Emergency; one that hangs ignores all frames.

        Args:
            frame: Received frame.
            now_us: Current time.
        """
        opcode = parse_opcode(frame.id)
        if self.is_hanging:
            return
        if opcode == Opcode.EMERGENCY:  # valid at any length, and while the module boots
            self._enter_emergency(now_us)
            return
        if self.state == ModuleState.BOOT:
            return
        if len(frame.data) != LENGTHS[opcode]:
            self.rejected_frame_count += 1
        elif opcode == Opcode.PARAMETER_REQUEST:
            driven = self.state in DRIVEN_STATES
            self.frames.append(self.parameters.handle_request(self.node_id, frame.data, driven))
        elif opcode == Opcode.COMMAND and has_valid_checksum(frame):
            action, key = read_command(frame.data)
            if key == COMMAND_KEY:
                self._execute_action(action, now_us)
        else:
            self.rejected_frame_count += 1

    def _execute_action(self, action: int, now_us: float) -> None:
        """Execute the action of a Command; an unknown one has no effect."""
        match action:
            case CommandAction.ARM:
                self._arm(now_us)
            case CommandAction.DISARM:
                self._disarm(now_us)
            case CommandAction.STOP:
                self._stop(now_us)
            case CommandAction.CLEAR:
                self._clear(now_us)
            case CommandAction.REBOOT:
                self.reboot(now_us)
            case CommandAction.IDENTIFY:
                self._send_identity()
            case _:
                pass

    def receive_setpoint(self, frame: CanFrame, now_us: float) -> None:
        """Check a setpoint for this node, and store it until the next Sync.

        A setpoint with a wrong length, checksum, counter or mode is rejected. MAX_WRONG_COUNTS wrong counters in a row
        are a fault. The first valid setpoint after a Sync feeds the watchdog.

        Args:
            frame: Received setpoint.
            now_us: Current time.
        """
        if self.state != ModuleState.ARMED or self.is_hanging:
            return
        if len(frame.data) != LENGTHS[Opcode.SET_POINT] or not has_valid_checksum(frame):
            self.rejected_frame_count += 1
            return
        mode, count, target_steps, limit_steps = read_setpoint(frame.data)
        if not self._is_counter_valid(count):
            self.rejected_frame_count += 1
            self._wrong_counts += 1
            if self._wrong_counts >= MAX_WRONG_COUNTS:
                self._fail(ModuleFault.STREAM, now_us)
            return
        self._wrong_counts = 0
        if mode > JointMode.TORQUE:
            self.rejected_frame_count += 1
            return
        # Otherwise a host without Syncs would keep an old demand active for ever.
        if self._has_sync_since_setpoint:
            self._watchdog_fed_us = now_us
            self._has_sync_since_setpoint = False
        target = target_steps * TARGET_STEPS[mode]  # position, velocity and torque share their bits
        if mode == JointMode.POSITION:
            target = self._clamp_angle(target)
        self._pending_demand = MotorDemand(MODES[mode], target, limit_steps * TORQUE_LIMIT_STEP_NM)

    def _is_counter_valid(self, count: int) -> bool:
        """Return whether a setpoint's counter follows the one before; a few setpoints in between may be lost."""
        expected = self._expected_count
        self._expected_count = (count + 1) % COUNTER_MODULUS
        if expected is None:
            return True
        lost_setpoints = (count - expected) % COUNTER_MODULUS
        return lost_setpoints <= MAX_LOST_SETPOINTS

    def _clamp_angle(self, angle_rad: float) -> float:
        limit_rad = self.parameters.values[ModuleParameter.ANGLE_LIMIT]
        return min(max(angle_rad, -limit_rad), limit_rad)

    def handle_sync(self, count: int, reading: ModuleReadings) -> None:
        """Respond to a Sync with the sensor readings of that moment, then follow the newest setpoint.

        Args:
            count: Number of the Sync, modulo 256.
            reading: Sensor readings at the Sync, in raw numbers.
        """
        if self.state == ModuleState.BOOT:
            return
        if self.is_hanging:
            if self._last_joint_state is not None:  # a transmit mailbox that is no longer refilled
                self.frames.append(self._last_joint_state)
            return
        self._report_joint_state(count, reading)
        self._report_contacts(count, reading)
        if self.is_imu_due():
            self._report_imu(count, reading)
        self._sync_count += 1
        self._has_sync_since_setpoint = True
        if self._pending_demand is not None:
            self.demand = self._pending_demand
            self._pending_demand = None

    def is_imu_due(self) -> bool:
        """Return whether gyro, accelerometer and shaft load answer the next Sync; neighbors do so in turn."""
        every = int(self.parameters.values[ModuleParameter.IMU_EVERY])
        return every > 0 and (self._sync_count + self.node_id) % every == 0

    # --- time ----------------------------------------------------------------------------------------------

    def poll(self, now_us: float) -> float:
        """Do everything that is due now: watchdog, fault detection, heartbeat and Health.

        Args:
            now_us: Current time in microseconds.

        Returns:
            The time at which the next call is due, in microseconds.
        """
        if self.is_hanging:
            return self._poll_hanging(now_us)
        if self.state == ModuleState.BOOT:
            if now_us < self._boot_start_us + BOOT_US:
                return self._boot_start_us + BOOT_US
            self._finish_boot(now_us)
        self._latch_new_faults(now_us)
        match self.state:
            case ModuleState.ARMED:
                if now_us >= self._watchdog_fed_us + self.watchdog_us:
                    self._fail(ModuleFault.WATCHDOG, now_us)
            case ModuleState.STOPPING:
                at_rest = abs(self.health.speed_rad_s) < AT_REST_RAD_S
                if at_rest or now_us >= self._stopping_start_us + self.watchdog_us:
                    self._enter_state(ModuleState.DISARMED, now_us)
            case _:
                pass
        if now_us >= self._next_heartbeat_us:
            self._next_heartbeat_us = max(self._next_heartbeat_us + HEARTBEAT_US, now_us)
            self.frames.append(self.make_heartbeat(now_us))
        if now_us >= self._next_health_us:
            self._next_health_us = max(self._next_health_us + HEALTH_US, now_us)
            self.frames.append(write_health(self.node_id, encode_health(self.health)))
        return self._compute_next_due_us(now_us)

    @property
    def watchdog_us(self) -> int:
        """Return how long a module acts on one setpoint, to the nearest microsecond."""
        return round(self.parameters.values[ModuleParameter.WATCHDOG] * 1e6)

    def reboot(self, now_us: float) -> None:
        """Reset everything that is not saved, and restart."""
        driven = self.state in DRIVEN_STATES
        self.parameters.restart()
        self._reset_state(now_us)
        self.last_stop = LastStop.REBOOT if driven else LastStop.NONE

    def _finish_boot(self, now_us: float) -> None:
        self._next_heartbeat_us = now_us + HEARTBEAT_US
        self._next_health_us = (
            now_us + HEALTH_US * (1 + self.node_id % HEALTH_PHASES) / HEALTH_PHASES
        )
        self._enter_state(self._state_after_boot, now_us)

    def _compute_next_due_us(self, now_us: float) -> float:
        report_us = min(self._next_heartbeat_us, self._next_health_us)
        match self.state:
            case ModuleState.ARMED:
                return min(report_us, self._watchdog_fed_us + self.watchdog_us)
            case ModuleState.STOPPING:
                return now_us
            case _:
                return report_us

    def _poll_hanging(self, now_us: float) -> float:
        """Run what still works while the main loop hangs; return when the next call is due.

        The main loop fed the hardware watchdog with every valid setpoint. When the watchdog expires it opens the
        motor's bridge.
        """
        watchdog_end_us = self._watchdog_fed_us + self.watchdog_us
        if self.demand.mode != JointMode.PASSIVE and now_us >= watchdog_end_us:
            self.demand = PASSIVE
        if self.demand.mode == JointMode.PASSIVE:
            return now_us + HEARTBEAT_US
        return watchdog_end_us

    # --- states --------------------------------------------------------------------------------------------

    def _reset_state(self, now_us: float) -> None:
        """Set state, setpoints and times to what they are when a module starts to boot.

        Args:
            now_us: Current time.
        """
        self.state = ModuleState.BOOT
        self._state_after_boot = ModuleState.DISARMED
        self.faults = 0  # bits of ModuleFault

        # Setpoints.
        self.demand = PASSIVE
        self._pending_demand: MotorDemand | None = None  # followed from the next Sync on
        self._expected_count: int | None = None  # counter of the next setpoint; None: any
        self._wrong_counts = 0  # in a row
        self._sync_count = 0
        # Whether a Sync has come since the setpoint that last fed the watchdog.
        self._has_sync_since_setpoint = True

        # Times.
        self._boot_start_us = now_us
        self._watchdog_fed_us = now_us  # when a setpoint last fed the watchdog
        self._stopping_start_us = now_us  # when STOPPING began
        self._next_heartbeat_us = now_us  # when the next heartbeat is due
        self._next_health_us = now_us  # when the next Health is due

    def _enter_state(
        self,
        state: ModuleState,
        now_us: float,
        reason: LastStop | None = None,
        demand: MotorDemand = PASSIVE,
    ) -> None:
        """Change the state of the module, drop all setpoints, and send a heartbeat.

        Args:
            state: New state.
            now_us: Current time.
            reason: Reason why a module leaves the state ARMED, reported in heartbeats from now on; None, or if it was
                not ARMED, for no new reason.
            demand: Demand of the motor in the new state.
        """
        if self.state == ModuleState.ARMED and reason is not None:
            self.last_stop = reason
        self.state = state
        self.demand = demand
        self._pending_demand = None
        self._expected_count = None
        self._wrong_counts = 0
        self.frames.append(self.make_heartbeat(now_us))

    def _arm(self, now_us: float) -> None:
        if self.state == ModuleState.DISARMED and not self._detect_present_faults():
            self._watchdog_fed_us = now_us
            self._has_sync_since_setpoint = True
            self._enter_state(ModuleState.ARMED, now_us)

    def _disarm(self, now_us: float) -> None:
        if self.state in DRIVEN_STATES:
            self._enter_state(ModuleState.DISARMED, now_us, LastStop.DISARM)

    def _stop(self, now_us: float) -> None:
        if self.state == ModuleState.ARMED:
            self._stopping_start_us = now_us
            self._enter_state(
                ModuleState.STOPPING, now_us, LastStop.STOP, self._make_stopping_demand()
            )

    def _make_stopping_demand(self) -> MotorDemand:
        """Return the demand while the module comes to rest in its stop mode."""
        values = self.parameters.values
        if values[ModuleParameter.STOP_MODE] == SafeMotion.DAMP:
            return MotorDemand(JointMode.VELOCITY, 0.0, values[ModuleParameter.TORQUE_LIMIT])
        return PASSIVE

    def _clear(self, now_us: float) -> None:
        if self.state in LATCHED_STATES and not self._detect_present_faults():
            self.faults = 0
            self._enter_state(ModuleState.DISARMED, now_us)

    def _enter_emergency(self, now_us: float) -> None:
        if self.state == ModuleState.BOOT:
            self._state_after_boot = ModuleState.EMERGENCY
        elif self.state != ModuleState.EMERGENCY:
            self._enter_state(ModuleState.EMERGENCY, now_us, LastStop.EMERGENCY)

    def _fail(self, fault: ModuleFault, now_us: float) -> None:
        """Latch a fault; an emergency is latched more strongly, and stays."""
        self.faults |= 1 << fault
        if self.state == ModuleState.EMERGENCY:
            self.frames.append(self.make_heartbeat(now_us))
        else:
            self._enter_state(ModuleState.FAULT, now_us, STOP_OF_FAULT[fault])

    def _detect_present_faults(self) -> int:
        """Return the bits of the faults whose cause is present. A winding that overheated must first cool down."""
        health = self.health
        overheated = self.faults >> ModuleFault.OVERHEAT & 1
        max_winding_c = self.heat.derate_from_c if overheated else self.heat.stop_at_c
        return (
            (health.winding_c >= max_winding_c) << ModuleFault.OVERHEAT
            | health.leak << ModuleFault.LEAK
            | (health.voltage_v < self._min_voltage_v) << ModuleFault.VOLTAGE
            | health.sensor_failed << ModuleFault.SENSOR
        )

    def _latch_new_faults(self, now_us: float) -> None:
        new_faults = self._detect_present_faults() & ~self.faults
        if not new_faults:
            return
        for fault in ModuleFault:
            if new_faults >> fault & 1:
                self._fail(fault, now_us)

    # --- reports -------------------------------------------------------------------------------------------

    def make_heartbeat(self, now_us: float) -> CanFrame:
        """Return the present heartbeat."""
        uptime_ms = min(round(now_us - self._boot_start_us) // 1000, MAX_UPTIME_MS)
        fault_bits = [self.faults >> fault & 1 for fault in ModuleFault]
        return write_heartbeat(
            self.node_id, (self.state, self.demand.mode, self.last_stop, *fault_bits, uptime_ms)
        )

    def _send_identity(self) -> None:
        identity = (self.serial, *FIRMWARE_VERSION, PROTOCOL_VERSION, IS_EMULATED, self._is_stepped)
        self.frames.append(write_identity(self.node_id, identity))

    def _report_joint_state(self, count: int, reading: ModuleReadings) -> None:
        raw_values = (
            reading.angle,
            reading.velocity,
            reading.torque,
            count,
            self.state,
            reading.derated,
        )
        self._last_joint_state = write_joint_state(self.node_id, raw_values)
        self.frames.append(self._last_joint_state)

    def _report_contacts(self, count: int, reading: ModuleReadings) -> None:
        values = self.parameters.values
        every = int(values[ModuleParameter.CONTACT_EVERY])
        if every == 0 or count % every != 0:
            return
        self.frames.append(write_contact(self.node_id, (*reading.contact, count)))
        if values[ModuleParameter.TAIL]:
            self.frames.append(write_tail_contact(self.node_id, (*reading.tail_contact, count)))

    def _report_imu(self, count: int, reading: ModuleReadings) -> None:
        if reading.gyro is not None and reading.acceleration is not None:
            self.frames.append(write_gyro(self.node_id, (*reading.gyro, count)))
            self.frames.append(write_acceleration(self.node_id, (*reading.acceleration, count)))
        if reading.shaft_load is not None:
            self.frames.append(write_shaft_load(self.node_id, (reading.shaft_load, count)))
