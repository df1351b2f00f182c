"""moteus controllers as a driver type of drives on CAN FD.

Every setpoint is a whole command in position mode: gains of the robot file as shares of the configured ones. Velocity
mode is a proportional gain of 0, torque mode both gains 0, passive that without torque. Answers say mode and fault.
"""

import logging
import math
from collections.abc import Sequence
from typing import Any

from snakesim_can_backend.can_drives.drives import HOST, CanDrives
from snakesim_can_backend.moteus.protocol import (
    FAULTS,
    FLOAT,
    HOST_ID,
    INT8,
    INT32,
    READ,
    REGISTER_MAP,
    RELATIVE,
    REPLY,
    WRITE,
    MoteusMode,
    Register,
    decode_subframes,
    encode_subframe,
    make_frame,
    split_addresses,
)
from snakesim_can_backend.protocol.definitions import Frame
from snakesim_drivers.kit.drive_states import DriveCommand
from snakesim_hal.model.joints import Joint
from snakesim_hal.wire.messages import Mode as JointMode

TURN = 2 * math.pi
OFF_BY_ITSELF = (MoteusMode.FAULT, MoteusMode.TIMEOUT)  # latched until a stop, which also clears the reason
NO_LIMIT = -1.0
IDENTITY = (
    encode_subframe(READ, INT32, Register.MAP_VERSION, count=1),
    encode_subframe(READ, INT8, Register.HOME_STATE, count=1),
)
MOTION = encode_subframe(READ, FLOAT, Register.MODE, count=4), encode_subframe(READ, INT8, Register.FAULT, count=1)
HEALTH = (
    encode_subframe(READ, FLOAT, Register.POWER, count=1),
    encode_subframe(READ, FLOAT, Register.MOTOR_TEMPERATURE, count=1),
    encode_subframe(READ, FLOAT, Register.VOLTAGE, count=2),
)
SERIAL_WORDS = 3
SERIAL = encode_subframe(READ, INT32, Register.SERIAL, count=SERIAL_WORDS)

_log = logging.getLogger("snakesim.moteus")


class Controllers(CanDrives):
    """All controllers of a bus."""

    unheard = "does not say its register map: it is off, has another id, or the bus another bit rate or sample point"

    def __init__(
        self, everybody: Sequence[Joint], settings: Any, joints: Sequence[Joint], *rest: Any, **kit: Any
    ) -> None:
        super().__init__(joints, *rest, **kit)
        self._kp_nm_per_turn, kd = kp, kd = configured_gains(everybody, settings)
        self._gains = [tuple(a / b for a, b in zip(shaft_gains(j), (kp, kd, kd), strict=True)) for j in joints]
        self._watchdog_s = settings.watchdog_s
        self._mode, self._home = [-1] * len(joints), [RELATIVE] * len(joints)

    def sender(self, frame: Frame) -> int | None:
        """Another host of our id is known by its writing."""
        source, destination = split_addresses(frame)
        if source == HOST_ID:
            return HOST if frame.data[:1] < bytes([READ]) else None
        return source if destination == HOST_ID else None

    def hear(self, i: int, frame: Frame) -> None:
        """One answer, to one of three questions."""
        said = {
            one.register + k: value
            for one in decode_subframes(frame.data)
            if one.kind == REPLY
            for k, value in enumerate(one.values)
        }
        if Register.POSITION in said:
            mode, fault = int(said[Register.MODE]), int(said[Register.FAULT])
            self._mode[i] = mode
            self.readings.mark_checked(i)
            self.readings.set_motion(i, said[Register.POSITION] * TURN, said[Register.VELOCITY] * TURN)
            self.readings.set_torque(i, said[Register.TORQUE])
            self.states.note_report(i, enabled=mode == MoteusMode.POSITION, state=f"in mode {mode}")
            named = f"fault {fault}, {FAULTS.get(fault, 'see its manual')}" if mode == MoteusMode.FAULT else ""
            self.states.drives[i].errors = "timeout: its watchdog expired" if mode == MoteusMode.TIMEOUT else named
        if Register.VOLTAGE in said:
            voltage_v = said[Register.VOLTAGE]
            self.readings.set_supply(i, voltage_v, said[Register.POWER] / max(voltage_v, 1.0))
            self.readings.set_temperatures(i, said[Register.MOTOR_TEMPERATURE], said[Register.BOARD_TEMPERATURE])
        if Register.MAP_VERSION in said:
            self.firmware[i], self._home[i] = (int(said[Register.MAP_VERSION]),), int(said[Register.HOME_STATE])
        if Register.SERIAL in said:
            words = [int(said[Register.SERIAL + k]) & 0xFFFF_FFFF for k in range(SERIAL_WORDS)]
            self.note_serial(i, "".join(f"{word:08X}" for word in reversed(words)))

    def identify(self, i: int) -> None:
        """Version of its registers, reference of its position, serial number, mode."""
        self._send(i, *IDENTITY, reply=True)
        self._send(i, SERIAL, reply=True)
        self.ask(i)

    def unfit(self, i: int) -> str:
        """Another register map, or a position that means nothing."""
        if self.firmware[i] != (REGISTER_MAP,):
            return f"has register map {self.firmware[i][0]}; this driver knows {REGISTER_MAP}: update its firmware"
        if self._home[i] == RELATIVE:
            return "does not know where it is: its position has no reference (home state 0); configure its encoders"
        return ""

    def ask(self, i: int) -> bool:
        """Mode, position, velocity, torque, fault."""
        return self._send(i, *MOTION, reply=True)

    def ask_health(self, i: int) -> None:
        """Power, temperatures and voltage; and the serial number, to notice a second controller of its id."""
        self._send(i, *HEALTH, reply=True)
        self._send(i, SERIAL, reply=True)

    def setpoint(self, i: int, mode: JointMode, target: float, limit_nm: float) -> None:
        """A command, which would also start it: so none to one that was restarted, or may be restarting."""
        restarted = self.states.drives[i].has_followed and self._mode[i] != MoteusMode.POSITION
        if restarted or self.readings.unanswered_requests(i):
            return
        stiffness, damping, velocity_gain = self._gains[i]
        position, velocity, torque, kp, kd = math.nan, 0.0, 0.0, 0.0, 0.0
        match mode:
            case JointMode.POSITION:
                position, kp, kd = target / TURN, stiffness, damping
            case JointMode.VELOCITY:
                velocity, kd = target / TURN, velocity_gain
            case JointMode.TORQUE | JointMode.PASSIVE:
                torque = target
        self._send(
            i,
            encode_subframe(WRITE, INT8, Register.MODE, MoteusMode.POSITION),
            encode_subframe(WRITE, FLOAT, Register.COMMAND, position, velocity, torque, kp, kd, limit_nm),
            encode_subframe(WRITE, FLOAT, Register.WATCHDOG, self._watchdog_s, NO_LIMIT, NO_LIMIT),
        )

    def tell(self, i: int, word: DriveCommand) -> None:
        """A setpoint is what makes it follow; a stop clears whatever has stopped a controller before."""
        if self._mode[i] in OFF_BY_ITSELF:
            return  # its reason is for the operator to reset
        match word:
            case "follow":
                return
            case "idle":
                if i not in self.readings.drives_to_check:  # else it is told again, once it says that it is on
                    self._stop(i)
            case "stop":
                self._stop(i)

    def set_up(self, i: int) -> None:
        """Nothing: every command is whole."""

    def forgive(self, i: int) -> None:
        """An expired watchdog."""
        if self._mode[i] == MoteusMode.TIMEOUT:
            _log.warning("%s: clearing an expired watchdog of an earlier run", self.states.drives[i].label)
            self._stop(i)

    def give_back(self, i: int) -> None:
        """Nothing: limits are part of each command."""

    def clear_errors(self, i: int) -> None:
        """Stopped: it clears faults, too."""
        self._stop(i)

    def _stop(self, i: int) -> None:
        self._send(i, encode_subframe(WRITE, INT8, Register.MODE, MoteusMode.STOPPED))

    def _send(self, i: int, *content: bytes, reply: bool = False) -> bool:
        return self.wire.send(make_frame(HOST_ID, self.nodes[i], *content, reply=reply))


def shaft_gains(joint: Joint) -> tuple[float, float, float]:
    """Stiffness in N·m/turn, damping and gain of velocity mode in N·m/(turn/s), at the shaft."""
    motor, at_shaft = joint.motor, TURN / joint.drive.gear**2
    gains = motor.stiffness_nm_per_rad, motor.damping_nm_s_per_rad, motor.velocity_gain_nm_s_per_rad
    stiffness, damping, velocity_gain = (gain * at_shaft for gain in gains)
    return stiffness, damping, velocity_gain


def needed_gains(joints: Sequence[Joint]) -> tuple[float, float]:
    """The gains that all joints' are shares of: `servo.pid_position.kp` and `kd`."""
    gains = [shaft_gains(joint) for joint in joints]
    return max(kp for kp, _, _ in gains), max(max(damping, velocity) for _, damping, velocity in gains)


def configured_gains(joints: Sequence[Joint], settings: Any) -> tuple[float, float]:
    """Those that the controllers have. joints: all of them."""
    kp, kd = needed_gains(joints)
    return settings.kp_nm_per_turn or kp or 1.0, settings.kd_nm_s_per_turn or kd or 1.0
