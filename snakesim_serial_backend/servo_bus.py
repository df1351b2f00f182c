"""The servos of one half-duplex serial bus, for any protocol: reading, silence, duplicate ids and faults.

A driver type derives from `SerialServos`, and adds what its registers mean.
"""

import time
from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

from snakesim_drivers.emulation.drive_emulator import DriveEmulator
from snakesim_drivers.emulation.emulated_body import FAULTS
from snakesim_drivers.kit.drives import Drives
from snakesim_drivers.kit.findings import FaultFinding
from snakesim_drivers.kit.readings import DriveReadings
from snakesim_hal.model.fault_kinds import FaultInjection
from snakesim_serial_backend.request_port import RequestPort, StatusT
from snakesim_serial_backend.wire import PseudoTerminal, is_emulated

BOOT_NS = 2_000_000_000  # in which the silence of a servo that restarts is no fault
INJECTABLE = {("bus", "cut"), *(("joint", kind) for kind in FAULTS)}
MAX_BAD_RESPONSES = 2  # in a row, doubled or garbled, until that is a fault: before `drive_silent`, which comes after 3
BUS_CUT = "nothing gets through; check the adapter, its cable and its power"
# Two servos with one id: their answers follow each other if their return delays differ, and collide if they do not.
RESPONDS_TWICE = "is duplicated: it answers one question twice; give each servo its own id"
GARBLED = (
    "a second servo has its id, or the line is disturbed; give each servo its own id, one after the other alone on the "
    "bus, and check cables and terminators"
)


PortT = TypeVar("PortT", bound=RequestPort[Any])


@dataclass(kw_only=True)
class SerialServo(Generic[PortT]):
    """What every servo on a serial bus has, whatever its protocol."""

    # How it is built.
    id: int
    name: str
    port: PortT

    # What it reported.
    enabled: bool = False  # whether its torque is on
    errors: int = 0  # bits of its hardware errors
    alert: bool = False  # whether it has errors that it has not named yet
    health_read_ns: int = -1  # when its state was last read
    answered_twice: int = 0  # requests in a row
    garbled: int = 0  # requests in a row that were answered by garbled bytes alone

    # What was sent to it.
    is_torque_requested: bool = False  # whether its torque was switched on
    torque_switched_ns: int = -1  # when its torque was switched on or off
    boot_start_ns: int = -1  # when it was restarted, until it answers again

    @property
    def label(self) -> str:
        """The name of the servo in messages."""
        return f"{self.name} (id {self.id} on {self.port.wire.port})"

    def record_switch(self, *, is_torque_requested: bool, now_ns: int) -> None:
        """Record that its torque was switched on or off."""
        self.is_torque_requested = is_torque_requested
        self.torque_switched_ns = now_ns
        self.enabled = False  # until it reports otherwise


class RegisterRange(NamedTuple):
    """Registers that are read at once."""

    address: int
    size: int  # bytes


ServoT = TypeVar("ServoT", bound=SerialServo[Any])


@dataclass(frozen=True, kw_only=True)
class ServoBusContext(Generic[ServoT, StatusT]):
    """What the servos of one port need, whatever their protocol."""

    servos: Sequence[ServoT]  # of this port, from tail to head
    port: RequestPort[StatusT]  # sends and receives packets
    readings: DriveReadings
    # The servos, if they are emulated in this process.
    emulator: DriveEmulator[PseudoTerminal] | None
    response_timeout_s: float  # time that a reading waits for answers
    clock_ns: Callable[[], int]


class SerialServos(Drives, Generic[ServoT, StatusT]):
    """All servos of a port, tail to head."""

    motion: ClassVar[RegisterRange]  # of all servos in every cycle
    state: ClassVar[RegisterRange]  # of servos that may have stopped by themselves
    health: ClassVar[RegisterRange]  # of one servo in every cycle
    torque_enable: ClassVar[int]  # address of the register that switches the torque

    def __init__(self, context: ServoBusContext[ServoT, StatusT]) -> None:
        """Prepare to drive the servos of a port that is open; nothing is sent."""
        self._emulator = context.emulator
        self.servos = list(context.servos)
        self.emulated = is_emulated(context.port.wire.port)
        self._port = context.port
        self._readings = context.readings
        self._clock_ns = context.clock_ns
        self._response_timeout_s = context.response_timeout_s
        # Read one by one, as they would silence others in a sync read.
        self._silent_servos: set[int] = set()
        self._cycle_count = 0
        self._read_deadline_s = 0.0
        # Until bring-up has checked that these are the servos of the robot.
        self._is_brought_up = False

    # --- what a driver type implements ------------------------------------------------------------------------

    @abstractmethod
    def handle_response(self, i: int, status: StatusT) -> None:
        """Put what a servo measures, the registers `motion`, into the readings."""

    @abstractmethod
    def _store_health(self, i: int, status: StatusT) -> None:
        """Put a servo's supply and temperature, of the registers `health`, into the readings, and store its state."""

    @abstractmethod
    def _store_state(self, i: int, status: StatusT) -> None:
        """Store whether a servo's torque is on, and what has switched it off, of the registers `state`."""

    @abstractmethod
    def _find_stop_reason(self, i: int) -> FaultFinding | None:
        """Return what has switched a servo's torque off, if anything."""

    # --- reading ----------------------------------------------------------------------------------------------

    def read(self) -> None:
        """Read all servos at once, one of the silent ones alone, and the health of one."""
        self._read_deadline_s = time.monotonic() + self._response_timeout_s
        self._cycle_count += 1
        silent_servos = sorted(self._silent_servos)
        answering = [i for i in range(len(self.servos)) if i not in self._silent_servos]
        self._read_states([i for i in answering if i in self._readings.drives_to_check])
        self._read_all_motion(answering)
        if silent_servos:
            self._read_silent_servo(silent_servos[self._cycle_count % len(silent_servos)])
        self._read_next_health([i for i in answering if i not in self._silent_servos])
        for i, servo in enumerate(self.servos):
            if servo.boot_start_ns >= 0 and self._clock_ns() - servo.boot_start_ns < BOOT_NS:
                self._readings.skip_request(i)

    def _read_all_motion(self, indices: list[int]) -> None:
        """Read the motion of these servos at once.

        A silent servo silences all behind it. So the first one without an answer is left out, and the others are read
        again, as often as time allows.
        """
        missing = indices
        while missing and time.monotonic() < self._read_deadline_s:
            ids = [self.servos[i].id for i in missing]
            responses = self._port.read_all(ids, *self.motion)
            for i in missing:
                response = responses.get(self.servos[i].id)
                if response is not None:
                    self.handle_response(i, response)
            missing = [i for i in missing if self.servos[i].id not in responses]
            if missing:
                self._silent_servos.add(missing.pop(0))

    def _read_silent_servo(self, i: int) -> None:
        """Read the motion of a silent servo alone, and count answers that are doubled or garbled."""
        servo = self.servos[i]
        responses = servo.port.read_alone(servo.id, *self.motion)
        if responses.surplus_count:
            servo.answered_twice += 1
        else:
            servo.answered_twice = 0
        if responses.garbled and not responses.statuses:
            servo.garbled += 1
        else:
            servo.garbled = 0
        if responses.statuses and not responses.surplus_count:
            self._silent_servos.clear()  # perhaps others answer again, too
            # An earlier one is a late answer to an earlier request.
            self.handle_response(i, responses.statuses[-1])

    def _read_states(self, indices: Sequence[int]) -> None:
        """Read at once whether these servos have stopped by themselves; a silent one is read again later."""
        responses = self._port.read_all([self.servos[i].id for i in indices], *self.state)
        for i in indices:
            status = responses.get(self.servos[i].id)
            if status is not None:
                self._store_state(i, status)

    def _read_next_health(self, indices: list[int]) -> None:
        """Read the health of one of these servos: first of those with an alert whose error is unknown, in turn."""
        servos_with_unknown_error = [
            i for i in indices if self.servos[i].alert and not self.servos[i].errors
        ]
        candidates = servos_with_unknown_error or indices
        if not candidates:
            return
        i = candidates[self._cycle_count % len(candidates)]
        servo = self.servos[i]
        status = servo.port.read(servo.id, *self.health)
        if status is not None:
            self._store_health(i, status)

    def poll(self) -> None:
        """Let servos that are emulated in this process run up to the current time."""
        self._port.wire.run_emulated_drives()

    def _write_to_servos(self, address: int, indices: Sequence[int], data: bytes) -> None:
        """Write the same data to registers of several servos."""
        self._port.write_all(address, [(self.servos[i].id, data) for i in indices])

    # --- faults -----------------------------------------------------------------------------------------------

    def list_findings(self) -> list[FaultFinding]:
        """Return what is wrong now with the port and its servos."""
        findings: list[FaultFinding] = []
        error = self._port.wire.error()
        if error:
            findings.append(
                FaultFinding("interface_down", f"{self._port.wire.port}: {error}; {BUS_CUT}")
            )
        for i, servo in enumerate(self.servos):
            for finding in (_find_response_problem(i, servo), self._find_stop_reason(i)):
                if finding is not None:
                    findings.append(finding)
        return findings

    def inject(self, injection: FaultInjection, *, begins: bool) -> bool:
        """Start or end a fault of emulated servos here, or of their bus. Returns whether it is possible."""
        if self._emulator is None or (injection.target_type, injection.kind) not in INJECTABLE:
            return False
        if injection.target_type == "joint":
            self._emulator.inject(injection, begins=begins)
        else:
            self._port.wire.set_cut(begins=begins)
        return True

    def close(self) -> None:
        """Switch the torque off, as far as the bus still works, and close the port."""
        try:
            if self._is_brought_up:
                self._write_to_servos(self.torque_enable, range(len(self.servos)), b"\0")
                self._port.wire.run_emulated_drives()
        finally:
            self._port.wire.close()
            if self._emulator is not None:
                self._emulator.close()


def _find_response_problem(i: int, servo: SerialServo[Any]) -> FaultFinding | None:
    """Return what is wrong with a servo's answers, if anything."""
    if servo.answered_twice >= MAX_BAD_RESPONSES:
        # It concerns the whole robot: which of the two servos is where is unknown.
        return FaultFinding("duplicate_node", f"{servo.label} {RESPONDS_TWICE}", i)
    if servo.garbled >= MAX_BAD_RESPONSES:
        return FaultFinding(
            "drive_silent",
            f"{servo.label} sends garbled bytes: {GARBLED}",
            i,
            affects_only_joint=True,
        )
    return None
