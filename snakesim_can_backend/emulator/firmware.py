"""One joint module's firmware, as a state machine: frames and time in, frames and a demand on the motor out.

    BOOT -> DISARMED -> ARMED -> STOPPING -> DISARMED
               ^          |         |
               +-- clear -- FAULT <-+          EMERGENCY from everywhere, left by clear only

Only ARMED and STOPPING drive the motor. Only a valid setpoint feeds the watchdog. Times are microseconds on one clock,
passed in; nothing here waits. `frames` collects frames to send; the caller empties it.
"""

from typing import NamedTuple

from snakesim_can_backend.emulator.frames import (
    LENGTHS,
    LIMIT_STEP,
    STEPS,
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
from snakesim_can_backend.emulator.reports import ModuleHealth, ModuleReadings, encode_health
from snakesim_can_backend.protocol.definitions import (
    COMMAND_KEY,
    COUNTER_MODULUS,
    HEALTH_PERIOD_S,
    HEARTBEAT_PERIOD_S,
    MAX_LOST_SETPOINTS,
    MAX_UPTIME_MS,
    MAX_WRONG_COUNTS,
    PROTOCOL_VERSION,
    CommandAction,
    Frame,
    LastStop,
    ModuleFault,
    ModuleParameter,
    ModuleState,
    Opcode,
    SafeMotion,
    has_valid_checksum,
)
from snakesim_hal.physics.thermal import HeatLimits
from snakesim_hal.wire.messages import Mode

BOOT_US = 100_000
HEARTBEAT_US = round(HEARTBEAT_PERIOD_S * 1e6)
HEALTH_US = round(HEALTH_PERIOD_S * 1e6)
AT_REST_RAD_S = 0.05
FIRMWARE = (1, 0)
MODES = tuple(Mode)
STOP_OF_FAULT = {fault: LastStop[fault.name] for fault in ModuleFault}


class Demand(NamedTuple):
    """Setpoint of the motor."""

    mode: Mode
    target: float  # rad, rad/s or N·m, as the mode says
    torque_limit_nm: float


PASSIVE = Demand(Mode.PASSIVE, 0.0, 0.0)


class ModuleFirmware:
    """One module on the bus."""

    def __init__(
        self,
        node: int,
        serial: int,
        parameters: ParameterStore,
        heat: HeatLimits,
        *,
        min_voltage_v: float = 18.0,
        stepped: bool = False,
        now_us: float = 0.0,
    ) -> None:
        """heat: temperature of its winding that stops it, and below which a clear is possible again.

        min_voltage_v: of its supply, below which it stops.
        """
        self._min_voltage_v = min_voltage_v
        self.node, self.serial, self.parameters, self.heat = node, serial, parameters, heat
        self.frames: list[Frame] = []
        self.health = ModuleHealth()
        self.hangs = False  # its main loop hangs; only hardware still works
        self.refused = 0  # frames with a wrong checksum, count or length
        self._stepped = stepped
        self._last_joint_state: Frame | None = None
        self._forget(now_us)
        self.last_stop = LastStop.NONE

    # --- frames from the bus -------------------------------------------------------------------------------

    def receive(self, frame: Frame, now_us: float) -> None:
        """An Emergency, Command or ParameterRequest for this node or, the first two, for all."""
        opcode = frame.id >> 6
        if self.hangs:
            return
        if opcode == Opcode.EMERGENCY:
            self._emergency(now_us)
        elif self.state == ModuleState.BOOT or len(frame.data) != LENGTHS[opcode]:
            self.refused += self.state != ModuleState.BOOT
        elif opcode == Opcode.PARAMETER_REQUEST:
            driven = self.state in (ModuleState.ARMED, ModuleState.STOPPING)
            self.frames.append(self.parameters.answer_request(self.node, frame.data, driven))
        elif opcode == Opcode.COMMAND and has_valid_checksum(frame):
            action, key = read_command(frame.data)
            if key == COMMAND_KEY:
                self._carry_out(action, now_us)
        else:
            self.refused += 1

    def _carry_out(self, action: int, now_us: float) -> None:
        """Carry out the action of a Command; an unknown one has no effect."""
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
                self._identify(now_us)
            case _:
                pass

    def receive_setpoint(self, frame: Frame, now_us: float) -> None:
        """A SetPoint for this node. It waits for the next Sync."""
        if self.state != ModuleState.ARMED or self.hangs:
            return
        if len(frame.data) != LENGTHS[Opcode.SET_POINT] or not has_valid_checksum(frame):
            self.refused += 1
            return
        mode, count, number, limit = read_setpoint(frame.data)
        expected, self._expected = self._expected, (count + 1) % COUNTER_MODULUS
        if expected is not None and (count - expected) % COUNTER_MODULUS > MAX_LOST_SETPOINTS:
            self.refused += 1
            self._wrong_counts += 1
            if self._wrong_counts >= MAX_WRONG_COUNTS:
                self._fail(ModuleFault.STREAM, now_us)
            return
        self._wrong_counts = 0
        if mode > Mode.TORQUE:
            self.refused += 1
            return
        if self._synced:  # otherwise a host without Syncs would keep an old demand active for ever
            self._fed_us, self._synced = now_us, False
        target = number * STEPS[mode]  # position, velocity and torque share their bits
        if mode == Mode.POSITION:
            target = self._within(target)
        self._pending = Demand(MODES[mode], target, limit * LIMIT_STEP)

    def sync(self, count: int, reading: ModuleReadings) -> None:
        """Answer a Sync with the sensor readings of that instant, then enact the newest setpoint."""
        if self.state == ModuleState.BOOT:
            return
        if self.hangs:
            if self._last_joint_state is not None:  # a transmit mailbox that is no longer refilled
                self.frames.append(self._last_joint_state)
            return
        values = self.parameters.values
        joint = (reading.angle, reading.velocity, reading.torque, count, self.state, reading.derated)
        self._last_joint_state = write_joint_state(self.node, joint)
        self.frames.append(self._last_joint_state)
        every = int(values[ModuleParameter.CONTACT_EVERY])
        if every and count % every == 0:
            self.frames.append(write_contact(self.node, (*reading.contact, count)))
            if values[ModuleParameter.TAIL]:
                self.frames.append(write_tail_contact(self.node, (*reading.tail_contact, count)))
        if self.imu_is_due():
            self._report_imu(count, reading)
        self._syncs += 1
        self._synced = True
        if self._pending is not None:
            self.demand, self._pending = self._pending, None

    def imu_is_due(self) -> bool:
        """Whether gyro, accelerometer and shaft load answer the next Sync; neighbors take turns."""
        every = int(self.parameters.values[ModuleParameter.IMU_EVERY])
        return every > 0 and (self._syncs + self.node) % every == 0

    # --- time ----------------------------------------------------------------------------------------------

    def poll(self, now_us: float) -> float:
        """Do what is due, with the present `inside`; returns the next due time."""
        if self.hangs:
            return self._poll_hanging(now_us)
        if self.state == ModuleState.BOOT:
            if now_us < self._booted_us + BOOT_US:
                return self._booted_us + BOOT_US
            self._heartbeat_us = now_us + HEARTBEAT_US
            self._health_us = now_us + HEALTH_US * (1 + self.node % 16) / 16  # not all at once
            self._enter(self._after_boot, now_us)
        self._watch_conditions(now_us)
        if self.state == ModuleState.ARMED and now_us >= self._fed_us + self.watchdog_us:
            self._fail(ModuleFault.WATCHDOG, now_us)
        elif self.state == ModuleState.STOPPING and (
            abs(self.health.speed_rad_s) < AT_REST_RAD_S or now_us >= self._stopping_us + self.watchdog_us
        ):
            self._enter(ModuleState.DISARMED, now_us)
        if now_us >= self._heartbeat_us:
            self._heartbeat_us = max(self._heartbeat_us + HEARTBEAT_US, now_us)
            self.frames.append(self.heartbeat(now_us))
        if now_us >= self._health_us:
            self._health_us = max(self._health_us + HEALTH_US, now_us)
            self.frames.append(write_health(self.node, encode_health(self.health)))
        return self._next_due(now_us)

    @property
    def watchdog_us(self) -> float:
        """How long a module acts on one setpoint."""
        return self.parameters.values[ModuleParameter.WATCHDOG] * 1e6

    def reboot(self, now_us: float) -> None:
        """Reset everything that is not saved, and restart."""
        driven = self.state in (ModuleState.ARMED, ModuleState.STOPPING)
        self.parameters.restart()
        self._forget(now_us)
        self.last_stop = LastStop.REBOOT if driven else LastStop.NONE

    # --- states --------------------------------------------------------------------------------------------

    def _forget(self, now_us: float) -> None:
        self.state, self._after_boot = ModuleState.BOOT, ModuleState.DISARMED
        self.faults = 0  # bits of ModuleFault
        self.demand = PASSIVE
        self._pending: Demand | None = None
        self._expected: int | None = None
        self._wrong_counts = 0
        self._booted_us = self._fed_us = self._stopping_us = self._heartbeat_us = self._health_us = now_us
        self._syncs = 0
        self._synced = True  # since the setpoint that last fed the watchdog

    def _enter(self, state: ModuleState, now_us: float, why: LastStop | None = None, demand: Demand = PASSIVE) -> None:
        """Change state, and drop the demand; why: reported for a module that was ARMED."""
        if self.state == ModuleState.ARMED and why is not None:
            self.last_stop = why
        self.state = state
        self.demand, self._pending = demand, None
        self._expected, self._wrong_counts = None, 0
        self.frames.append(self.heartbeat(now_us))

    def _arm(self, now_us: float) -> None:
        if self.state == ModuleState.DISARMED and not self._conditions():
            self._fed_us, self._synced = now_us, True
            self._enter(ModuleState.ARMED, now_us)

    def _disarm(self, now_us: float) -> None:
        if self.state in (ModuleState.ARMED, ModuleState.STOPPING):
            self._enter(ModuleState.DISARMED, now_us, LastStop.DISARM)

    def _stop(self, now_us: float) -> None:
        if self.state == ModuleState.ARMED:
            self._stopping_us = now_us
            values = self.parameters.values
            damped = Demand(Mode.VELOCITY, 0.0, values[ModuleParameter.TORQUE_LIMIT])
            safe = damped if values[ModuleParameter.STOP_MODE] == SafeMotion.DAMP else PASSIVE
            self._enter(ModuleState.STOPPING, now_us, LastStop.STOP, safe)

    def _clear(self, now_us: float) -> None:
        if self.state in (ModuleState.FAULT, ModuleState.EMERGENCY) and not self._conditions():
            self.faults = 0
            self._enter(ModuleState.DISARMED, now_us)

    def _emergency(self, now_us: float) -> None:
        if self.state == ModuleState.BOOT:
            self._after_boot = ModuleState.EMERGENCY
        elif self.state != ModuleState.EMERGENCY:
            self._enter(ModuleState.EMERGENCY, now_us, LastStop.EMERGENCY)

    def _fail(self, fault: ModuleFault, now_us: float) -> None:
        self.faults |= 1 << fault
        if self.state == ModuleState.EMERGENCY:
            self.frames.append(self.heartbeat(now_us))
        else:
            self._enter(ModuleState.FAULT, now_us, STOP_OF_FAULT[fault])

    def _conditions(self) -> int:
        """Bits of the faults whose cause is present. A winding that overheated must cool well below that."""
        inside = self.health
        hot = self.heat.derate_from_c if self.faults >> ModuleFault.OVERHEAT & 1 else self.heat.stop_at_c
        return (
            (inside.winding_c >= hot) << ModuleFault.OVERHEAT
            | inside.leak << ModuleFault.LEAK
            | (inside.voltage_v < self._min_voltage_v) << ModuleFault.VOLTAGE
        )

    def _watch_conditions(self, now_us: float) -> None:
        new = self._conditions() & ~self.faults
        for fault in ModuleFault if new else ():
            if new >> fault & 1:
                self._fail(fault, now_us)

    def _within(self, angle_rad: float) -> float:
        most = self.parameters.values[ModuleParameter.ANGLE_LIMIT]
        return min(max(angle_rad, -most), most)

    def _next_due(self, now_us: float) -> float:
        due = min(self._heartbeat_us, self._health_us)
        if self.state == ModuleState.ARMED:
            return min(due, self._fed_us + self.watchdog_us)
        return now_us if self.state == ModuleState.STOPPING else due

    def _poll_hanging(self, now_us: float) -> float:
        """The hardware watchdog, which the main loop fed with every valid setpoint, opens the motor's bridge."""
        if self.demand.mode != Mode.PASSIVE and now_us >= self._fed_us + self.watchdog_us:
            self.demand = PASSIVE
        return now_us + HEARTBEAT_US if self.demand.mode == Mode.PASSIVE else self._fed_us + self.watchdog_us

    # --- reports -------------------------------------------------------------------------------------------

    def heartbeat(self, now_us: float) -> Frame:
        """The present heartbeat."""
        uptime_ms = min(round(now_us - self._booted_us) // 1000, MAX_UPTIME_MS)
        faults = [self.faults >> fault & 1 for fault in ModuleFault]
        state = (self.state, self.demand.mode, self.last_stop, *faults, uptime_ms)
        return write_heartbeat(self.node, state)

    def _identify(self, _now_us: float) -> None:
        self.frames.append(write_identity(self.node, (self.serial, *FIRMWARE, PROTOCOL_VERSION, 1, self._stepped)))

    def _report_imu(self, count: int, reading: ModuleReadings) -> None:
        if reading.gyro is not None and reading.acceleration is not None:
            self.frames.append(write_gyro(self.node, (*reading.gyro, count)))
            self.frames.append(write_acceleration(self.node, (*reading.acceleration, count)))
        if reading.shaft_load is not None:
            self.frames.append(write_shaft_load(self.node, (reading.shaft_load, count)))
