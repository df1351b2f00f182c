"""ODrive axes as a family of drives: a `snakesim_hal.drivers.drive_backend.Drives`.

Each tick every axis is asked for motion and current, and one of them for heat, supply and errors. Position mode is the
axis' own cascade, with gains that make it the PD law of the robot file; passive is a torque of 0, without a change of
state.
"""

import math
import struct
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from snakesim_can_backend.bus.bus import VirtualPeer, Wire, wait
from snakesim_can_backend.bus.bus_errors import BUS_FAULTS
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
from snakesim_hal.arrays import Floats
from snakesim_hal.drivers.findings import Finding
from snakesim_hal.drivers.readings import Readings
from snakesim_hal.drivers.twin_body import FAULTS
from snakesim_hal.errors import BackendError, ConfigError
from snakesim_hal.injection import Injection
from snakesim_hal.model.joints import Joint
from snakesim_hal.wire.messages import Mode

TURN = 2 * math.pi
ASK_EVERY_S = 0.1
FOLLOWS_WITHIN_NS = 500_000_000  # a heartbeat or two after it was enabled
REMIND_AFTER_NS = 150_000_000  # a heartbeat later
STRANGER_FRAMES = 3
LEFT_BEHIND = Error.WATCHDOG_TIMER_EXPIRED  # by a driver that was killed
CONTROLS = {
    Mode.PASSIVE: Control.TORQUE,
    Mode.TORQUE: Control.TORQUE,
    Mode.VELOCITY: Control.VELOCITY,
    Mode.POSITION: Control.POSITION,
}


@dataclass
class Axis:
    """One axis: what it said last, and what it was told."""

    node: int
    name: str
    wire: Wire
    torque_constant: float  # N·m/A
    position_gain: float  # 1/s
    damping: float  # N·m / (turn/s), position mode
    velocity_gain: float  # N·m / (turn/s), velocity mode
    speed_limit: float  # turns/s
    firmware: tuple[int, ...] = ()
    state: int = 0
    errors: int = 0
    heartbeat_ns: int = -1
    follows: bool = False
    followed: bool = False  # since it was enabled
    stopped: bool = False  # by the emergency stop that it was sent
    told_ns: int = -1  # when it was enabled or let go
    mode: Mode | None = None
    limit_nm: float = -1.0

    def send(self, message: Message, *values: float) -> bool:
        """A message to it."""
        return self.wire.send(write(self.node, message, *values))

    def ask(self, *questions: Message) -> bool:
        """Questions to it; whether the bus took them."""
        taken = [self.wire.send(ask(self.node, question)) for question in questions]
        return all(taken)


class Axes:
    """All axes of a robot, tail to head."""

    def __init__(
        self,
        joints: Sequence[Joint],
        wires: Sequence[Wire],
        constants: Sequence[float],
        readings: Readings,
        *,
        twin: VirtualPeer | None,
        emulated: bool,
        answer_s: float,
        bring_up_s: float,
        clock_ns: Callable[[], int],
    ) -> None:
        """wires: of every joint; constants: torque constants, N·m/A; twin: the axes, if they are emulated here.

        answer_s: how long a tick waits for answers.
        """
        self.emulated, self._twin = emulated, twin
        self.axes = [axis_of(*row) for row in zip(joints, wires, constants, strict=True)]
        self._wires = list({id(wire): wire for wire in wires}.values())
        self._at = {(id(axis.wire), axis.node): i for i, axis in enumerate(self.axes)}
        self._readings, self._clock_ns = readings, clock_ns
        self._answer_s, self._bring_up_s = answer_s, bring_up_s
        self._turn = 0  # whose health is asked for next
        self._strangers: Counter[int] = Counter()
        self._others = False  # whether somebody else commands axes
        self._ours = False

    # --- bring-up ---------------------------------------------------------------------------------------------

    def bring_up(self) -> None:
        """Versions, then settings; every axis is idle, and stays so."""
        self._await(lambda axis: bool(axis.firmware), Message.VERSION, Message.ERROR)
        wrong = [
            f"  {axis.name} (node {axis.node} on {axis.wire.channel}) {why}"
            for axis in self.axes
            if (why := unfit(axis))
        ]
        if self._others:
            raise BackendError("another program commands axes on this bus; end it first. Nothing was sent")
        if wrong:
            raise BackendError("the robot is not complete; nothing was enabled:", *wrong)
        self._ours = True
        for axis in self.axes:
            axis.send(Message.SET_STATE, State.IDLE)
            if axis.errors and not axis.errors & ~LEFT_BEHIND:
                axis.send(Message.CLEAR_ERRORS)
        self._write_settings(self.axes)
        known = self._readings.known
        self._await(lambda axis: known(self.axes.index(axis)), Message.MOTION, Message.CURRENT)
        silent = [axis.name for i, axis in enumerate(self.axes) if not known(i)]
        if silent:
            raise BackendError(f"{', '.join(silent)}: no encoder estimates and currents; nothing was enabled")
        for axis in self.axes:
            axis.ask(Message.SUPPLY, Message.TEMPERATURE, Message.ERROR)
        self._receive()
        self._strangers.clear()

    def _await(self, done: Callable[[Axis], bool], *questions: Message) -> None:
        end, ask_at = time.monotonic() + self._bring_up_s, 0.0
        while (now := time.monotonic()) < end and not all(map(done, self.axes)):
            if now >= ask_at:
                for axis in self.axes:
                    axis.ask(*questions)
                ask_at = now + ASK_EVERY_S
            if not wait(self._wires, 0.01):
                time.sleep(0.001)
            self._receive()

    def _write_settings(self, axes: Iterable[Axis]) -> None:
        """What is not in an axis' memory after a restart; the rest is written when it follows."""
        for axis in axes:
            axis.limit_nm, axis.mode = -1.0, None
            axis.send(Message.SET_POSITION_GAIN, axis.position_gain)

    # --- a tick -----------------------------------------------------------------------------------------------

    def read(self) -> None:
        """Ask, and wait for those who answered lately."""
        self._receive()
        for i, axis in enumerate(self.axes):
            if not axis.ask(Message.MOTION, Message.CURRENT):
                self._readings.not_asked(i)
        self._turn = (self._turn + 1) % len(self.axes)
        self.axes[self._turn].ask(Message.SUPPLY, Message.TEMPERATURE, Message.ERROR)
        end = time.monotonic() + self._answer_s
        while self._readings.incomplete() and (left_s := end - time.monotonic()) > 0:
            if not wait(self._wires, left_s):
                break
            self._receive()

    def let_run(self) -> None:
        """Receive."""
        wait(self._wires, 0.0)
        self._receive()

    def command(
        self, following: frozenset[int], modes: list[Mode], targets: Floats, limits_nm: Floats, *, emergency: bool
    ) -> None:
        """Set-points; enable, let go, remind."""
        now_ns = self._clock_ns()
        for i, axis in enumerate(self.axes):
            if i in following:
                self._set(axis, modes[i], float(targets[i]), float(limits_nm[i]))
            changes = axis.follows != (i in following)
            if changes:
                axis.follows, axis.followed, axis.told_ns = i in following, False, now_ns
                if not axis.follows:
                    axis.mode = None
            elif axis.followed or (axis.follows and now_ns - axis.told_ns > FOLLOWS_WITHIN_NS):
                continue  # it follows; or it has been told often enough, and is a finding
            wanted = State.CLOSED_LOOP if axis.follows else State.IDLE
            heard = axis.heartbeat_ns - axis.told_ns > REMIND_AFTER_NS
            if changes or (heard and axis.state != wanted and axis.state):
                if emergency and not axis.follows:
                    axis.stopped = True
                    axis.send(Message.ESTOP)
                else:
                    axis.send(Message.SET_STATE, wanted)

    def _set(self, axis: Axis, mode: Mode, target: float, limit_nm: float) -> None:
        if limit_nm != axis.limit_nm and axis.send(
            Message.SET_LIMITS, axis.speed_limit, limit_nm / axis.torque_constant
        ):
            axis.limit_nm = limit_nm
        match mode:
            case Mode.POSITION:
                axis.send(Message.SET_POSITION, target / TURN, 0, 0)
            case Mode.VELOCITY:
                axis.send(Message.SET_VELOCITY, target / TURN, 0.0)
            case Mode.TORQUE | Mode.PASSIVE:
                axis.send(Message.SET_TORQUE, target)
        if mode != axis.mode:
            gain = axis.damping if mode == Mode.POSITION else axis.velocity_gain
            sent = axis.send(Message.SET_VELOCITY_GAINS, gain, 0.0)
            if axis.send(Message.SET_MODE, CONTROLS[mode], PASSTHROUGH) and sent:
                axis.mode = mode

    def clear(self, joints: frozenset[int]) -> None:
        """Errors, and what a restart has lost; what an axis says of errors from now on is of after the clear."""
        cleared = [self.axes[i] for i in sorted(joints)]
        for axis in cleared:
            axis.errors, axis.stopped = 0, False
            axis.send(Message.CLEAR_ERRORS)
            axis.ask(Message.ERROR)
        self._write_settings(cleared)

    def inject(self, injection: Injection, *, begins: bool) -> bool:
        """Faults of buses, and of axes that are emulated here."""
        if injection.target_type == "bus":
            if injection.number >= len(self._wires):
                raise ConfigError(f"there is no {injection.target}; this robot has bus_1 to bus_{len(self._wires)}")
            self._wires[injection.number].inject(injection.kind, begins=begins)
            return True
        if self._twin is None or injection.kind not in FAULTS:
            return False
        self._twin.inject(injection, begins=begins)
        return True

    def close(self) -> None:
        """Idle, as far as the buses still work."""
        for axis in self.axes if self._ours else ():
            try:
                axis.send(Message.SET_STATE, State.IDLE)
            except BackendError:
                continue
        for wire in self._wires:
            try:
                wire.idle()
            finally:
                wire.close()

    # --- what is wrong ----------------------------------------------------------------------------------------

    def findings(self) -> list[Finding]:
        """Of buses, strangers and axes."""
        found = [
            Finding(error.kind, f"{error.channel}: {error.detail}; {BUS_FAULTS[error.kind]}")
            for wire in self._wires
            for error in wire.errors()
            if error.kind in BUS_FAULTS
        ]
        if self._others:
            found.append(Finding("second_host", "another program commands axes on this bus; end one of the two"))
            self._others = False
        for node, frames in self._strangers.items():
            if frames >= STRANGER_FRAMES:
                found.append(Finding("unknown_node", f"node {node} is on the bus, but is not a joint of this robot"))
        now_ns = self._clock_ns()
        for i, axis in enumerate(self.axes):
            who = f"{axis.name} (node {axis.node} on {axis.wire.channel})"
            errors = axis.errors & ~Error.ESTOP_REQUESTED if axis.stopped else axis.errors
            late = axis.followed or now_ns - axis.told_ns > FOLLOWS_WITHIN_NS
            if errors:
                found.append(Finding("drive_fault", f"{who} reports {names(errors)}", i, alone=True))
            elif axis.follows and late and axis.state != State.CLOSED_LOOP:
                cause = f"{who} does not follow: its state is {axis.state}, not {int(State.CLOSED_LOOP)}"
                found.append(Finding("drive_not_armed", cause, i, alone=axis.followed))
        return found

    def _receive(self) -> None:
        for wire in self._wires:
            for frame in wire.receive():
                self.take(wire, frame)

    def take(self, wire: Wire, frame: Frame) -> None:
        """One frame of a bus."""
        node, message = parted(frame)
        if not frame.data and message not in (Message.ESTOP, Message.CLEAR_ERRORS):
            return  # a question of somebody else
        if message in FROM_HOST:
            self._others = True
            return
        i = self._at.get((id(wire), node))
        if i is None:
            self._strangers[node] += 1
            return
        try:
            known = Message(message)
            self._hear(i, self.axes[i], known, PAYLOADS[known].unpack(frame.data))
        except (ValueError, struct.error):
            return

    def _hear(self, i: int, axis: Axis, message: Message, values: tuple[float, ...]) -> None:
        if not all(map(math.isfinite, values)):
            return
        readings = self._readings
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
                axis.errors, axis.state, axis.heartbeat_ns = int(values[0]), int(values[1]), self._clock_ns()
                enabled = axis.follows and axis.heartbeat_ns - axis.told_ns > REMIND_AFTER_NS
                axis.followed |= enabled and axis.state == State.CLOSED_LOOP
            case Message.ERROR:
                axis.errors = int(values[0])
            case Message.VERSION:
                axis.firmware = tuple(map(int, values[4:7]))
            case _:
                pass


def axis_of(joint: Joint, wire: Wire, constant: float) -> Axis:
    """An axis with the gains of its joint, at its shaft."""
    motor, gear = joint.motor, joint.drive.gear
    return Axis(
        node=joint.id,
        name=joint.name,
        wire=wire,
        torque_constant=constant,
        position_gain=motor.stiffness_nm_per_rad / motor.damping_nm_s_per_rad,
        damping=motor.damping_nm_s_per_rad / gear**2 * TURN,
        velocity_gain=motor.velocity_gain_nm_s_per_rad / gear**2 * TURN,
        speed_limit=joint.limits.speed_rad_s * gear / TURN,
    )


def unfit(axis: Axis) -> str:
    """Why an axis cannot be used; empty if it can."""
    if not axis.firmware:
        return "does not say its version: it is off, has another id or bit rate, or firmware 0.5, which does not say it"
    if axis.firmware[:2] != FIRMWARE:
        return f"has firmware {'.'.join(map(str, axis.firmware))}; this driver knows {FIRMWARE[0]}.{FIRMWARE[1]}"
    return ""
