"""ODrive axes as a family of drives on CAN.

Position mode is the axis' own cascade, with gains that make it the PD law of the robot file; passive is a torque of 0,
without a change of state. Heartbeats say state and errors.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from snakesim_can_backend.family.drives import HOST, CanDrives
from snakesim_can_backend.odrive.protocol import (
    FIRMWARE,
    FROM_HOST,
    PASSTHROUGH,
    PAYLOADS,
    Control,
    Error,
    Message,
    State,
    ask,
    names,
    parted,
    write,
)
from snakesim_can_backend.protocol.definitions import Frame
from snakesim_hal.drivers.following import Word
from snakesim_hal.model.joints import Joint
from snakesim_hal.wire.messages import Mode

TURN = 2 * math.pi
TWIN_CONSTANT = 1.0  # N·m/A, of twins whose robot file says none
LEFT_BEHIND = Error.WATCHDOG_TIMER_EXPIRED  # by a driver that was killed
CONTROLS = {
    Mode.PASSIVE: Control.TORQUE,
    Mode.TORQUE: Control.TORQUE,
    Mode.VELOCITY: Control.VELOCITY,
    Mode.POSITION: Control.POSITION,
}


@dataclass
class Axis:
    """One axis: its settings, at its shaft, and which of them it has been sent."""

    torque_constant: float  # N·m/A
    position_gain: float  # 1/s
    damping: float  # N·m / (turn/s), position mode
    velocity_gain: float  # N·m / (turn/s), velocity mode
    speed_limit: float  # turns/s
    errors: int = 0
    mode: Mode | None = None
    limit_nm: float = -1.0


class Axes(CanDrives):
    """All axes of a bus."""

    unheard = "does not say its version: it is off, has another id or bit rate, or firmware 0.5, which does not say it"

    def __init__(self, _everybody: object, _settings: object, joints: Sequence[Joint], *rest: Any, **kit: Any) -> None:
        super().__init__(joints, *rest, **kit)
        self.axes = [axis_of(joint) for joint in joints]

    def sender(self, frame: Frame) -> int | None:
        """Questions have no data."""
        node, message = parted(frame)
        if not frame.data and message not in (Message.ESTOP, Message.CLEAR_ERRORS):
            return None
        return HOST if message in FROM_HOST else node

    def hear(self, i: int, frame: Frame) -> None:
        """Answers and heartbeats."""
        message, axis, readings = Message(parted(frame)[1]), self.axes[i], self.readings
        values = PAYLOADS[message].unpack(frame.data)
        match message:
            case Message.MOTION:
                readings.moved(i, values[0] * TURN, values[1] * TURN)
            case Message.CURRENT:
                readings.pushed(i, values[1] * axis.torque_constant)
            case Message.SUPPLY:
                readings.supplied(i, values[0], values[1])
            case Message.TEMPERATURE:
                readings.warmed(i, values[1], values[0])
            case Message.HEARTBEAT:
                self.following.says(i, enabled=values[1] == State.CLOSED_LOOP, state=f"in state {values[1]}")
                self._errs(i, values[0])
            case Message.ERROR:
                self._errs(i, values[0])
            case Message.VERSION:
                self.firmware[i] = values[4:7]
                readings.identified(i, firmware=".".join(map(str, values[4:7])))
                if values[4:6] == FIRMWARE:  # 0.5 would take the question for a new node id
                    self._ask(i, Message.ADDRESS)
            case Message.ADDRESS:
                readings.identified(i, serial=f"{int.from_bytes(values[1], 'little'):012X}")
            case _:
                pass

    def _errs(self, i: int, errors: int) -> None:
        self.readings.state_was_read(i)
        drive, self.axes[i].errors = self.following.drives[i], errors
        drive.errors = names(errors & ~Error.ESTOP_REQUESTED if drive.stopped else errors)

    def identify(self, i: int) -> None:
        """Version and errors."""
        self._ask(i, Message.VERSION, Message.ERROR)

    def unfit(self, i: int) -> str:
        """Another firmware."""
        said = ".".join(map(str, self.firmware[i]))
        known = self.firmware[i][:2] == FIRMWARE
        return "" if known else f"has firmware {said}; this driver knows {FIRMWARE[0]}.{FIRMWARE[1]}"

    def ask(self, i: int) -> bool:
        """Encoder estimates and current; before them errors, of an axis that may have stopped by itself."""
        if i in self.readings.doubted:
            self._ask(i, Message.ERROR)
        return self._ask(i, Message.MOTION, Message.CURRENT)

    def ask_health(self, i: int) -> None:
        """Three questions."""
        self._ask(i, Message.SUPPLY, Message.TEMPERATURE, Message.ERROR)

    def set_point(self, i: int, mode: Mode, target: float, limit_nm: float) -> None:
        """An input; before it limits, after it gains and mode, if they change."""
        axis = self.axes[i]
        if limit_nm != axis.limit_nm and self._send(
            i, Message.SET_LIMITS, axis.speed_limit, limit_nm / axis.torque_constant
        ):
            axis.limit_nm = limit_nm
        match mode:
            case Mode.POSITION:
                self._send(i, Message.SET_POSITION, target / TURN, 0, 0)
            case Mode.VELOCITY:
                self._send(i, Message.SET_VELOCITY, target / TURN, 0.0)
            case Mode.TORQUE | Mode.PASSIVE:
                self._send(i, Message.SET_TORQUE, target)
        if mode != axis.mode:
            gain = axis.damping if mode == Mode.POSITION else axis.velocity_gain
            sent = self._send(i, Message.SET_VELOCITY_GAINS, gain, 0.0)
            if self._send(i, Message.SET_MODE, CONTROLS[mode], PASSTHROUGH) and sent:
                axis.mode = mode

    def tell(self, i: int, word: Word) -> None:
        """By its state; an emergency stop is an error that it keeps."""
        if word == "stop":
            self._send(i, Message.ESTOP)
        else:
            self._send(i, Message.SET_STATE, State.CLOSED_LOOP if word == "follow" else State.IDLE)
        if word != "follow":
            self.axes[i].mode = None

    def set_up(self, i: int) -> None:
        """Its gain; the rest is written when it follows."""
        axis = self.axes[i]
        axis.limit_nm, axis.mode = -1.0, None
        self._send(i, Message.SET_POSITION_GAIN, axis.position_gain)

    def forgive(self, i: int) -> None:
        """An expired watchdog."""
        if self.axes[i].errors and not self.axes[i].errors & ~LEFT_BEHIND:
            self._send(i, Message.CLEAR_ERRORS)

    def clear_errors(self, i: int) -> None:
        """And ask what is left."""
        self._send(i, Message.CLEAR_ERRORS)
        self._ask(i, Message.ERROR)

    def _send(self, i: int, message: Message, *values: float) -> bool:
        return self.wire.send(write(self.nodes[i], message, *values))

    def _ask(self, i: int, *questions: Message) -> bool:
        taken = [self.wire.send(ask(self.nodes[i], question)) for question in questions]
        return all(taken)


def axis_of(joint: Joint) -> Axis:
    """An axis with the gains of its joint, at its shaft."""
    motor, gear = joint.motor, joint.drive.gear
    return Axis(
        torque_constant=motor.torque_constant_nm_per_a or TWIN_CONSTANT,
        position_gain=motor.stiffness_nm_per_rad / motor.damping_nm_s_per_rad,
        damping=motor.damping_nm_s_per_rad / gear**2 * TURN,
        velocity_gain=motor.velocity_gain_nm_s_per_rad / gear**2 * TURN,
        speed_limit=joint.limits.speed_rad_s * gear / TURN,
    )
