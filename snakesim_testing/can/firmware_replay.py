"""Compares the emulator of a joint module with the reference firmware in C on the same events.

An event is a line of text, which `snakesim_native/joint_module/replay/replay.c` explains. An `Answer` is what a module
does in response. `find_difference` returns the first event that the two answer differently.
"""

import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from snakesim_can_backend.emulator.firmware import ModuleFirmware
from snakesim_can_backend.emulator.frames import LENGTHS, ModuleReadings, read_sync
from snakesim_can_backend.emulator.parameters import ParameterStore, make_factory_defaults
from snakesim_can_backend.protocol.codec import load_layouts
from snakesim_can_backend.protocol.definitions import (
    BROADCAST,
    CanFrame,
    ModuleState,
    Opcode,
    parse_node,
    parse_opcode,
)
from snakesim_hal.physics.thermal import HeatLimits

DEMAND_TOLERANCE = 1e-5  # rad, rad/s or N·m; a step on the bus is ten times as long
LAST_ID = 0x7FF  # of a standard CAN frame
ANSWERED_EVENTS = ("frame", "poll")
STATE_MARK = "|"  # before the state of the module, in each answer


@dataclass(frozen=True)
class Answer:
    """What a module does at one event, and the state that it is in afterwards."""

    frames: tuple[str, ...]  # as ID#DATA, in hexadecimal
    state: int
    faults: int
    last_stop: int
    mode: int
    target: float
    torque_limit_nm: float
    rejected_frames: int
    due_us: int | None  # when the next poll is due; None unless the event is a poll
    dropped_frames: int = 0  # since `init`, because the outbox was full
    # What the firmware demands of its board. The emulator has no board, and these are always false.
    feeds_bridge: bool = False
    writes_flash: bool = False

    def agrees_with(self, other: "Answer") -> bool:
        """Return whether two answers are the same: exactly, but for rounding errors in the demand.

        What the firmware demands of its board is not compared.
        """
        own_demand = (self.target, self.torque_limit_nm)
        other_demand = (other.target, other.torque_limit_nm)
        is_same_demand = all(
            abs(a - b) <= DEMAND_TOLERANCE for a, b in zip(own_demand, other_demand, strict=True)
        )
        return is_same_demand and self._exact_fields() == other._exact_fields()

    def _exact_fields(self) -> tuple[object, ...]:
        return (
            self.frames,
            self.state,
            self.faults,
            self.last_stop,
            self.mode,
            self.rejected_frames,
            self.due_us,
            self.dropped_frames,
        )


# --- the reference firmware -------------------------------------------------------------------------------------


def run_reference(program: Path, events: Sequence[str]) -> list[Answer]:
    """Return the answers of the reference firmware, in order."""
    return parse_answers(events, _run_program(program, events))


def parse_answers(events: Sequence[str], lines: Sequence[str]) -> list[Answer]:
    """Return the answers in the lines that the program has printed for some events."""
    answering_events = [event for event in events if event.startswith(ANSWERED_EVENTS)]
    answer_lines = [line for line in lines if STATE_MARK in line]
    return [
        _parse_answer(event, line)
        for event, line in zip(answering_events, answer_lines, strict=True)
    ]


def run_torques(program: Path, events: Sequence[str]) -> list[tuple[float, bool]]:
    """Return for each event `torque` the torque of the motor in N·m, and whether heat reduces it."""
    lines = [line.split() for line in _run_program(program, events) if STATE_MARK not in line]
    return [(float(torque_nm), is_derated == "1") for torque_nm, is_derated in lines]


def _run_program(program: Path, events: Sequence[str]) -> list[str]:
    """Return the lines that the program prints."""
    completed = subprocess.run(
        [str(program)],
        input="\n".join(events) + "\n",
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert completed.returncode == 0, completed.stderr
    return completed.stdout.splitlines()


def _parse_answer(event: str, line: str) -> Answer:
    frames, _, rest = line.partition(STATE_MARK)
    state, faults, last_stop, mode, target, limit, rejected, dropped, bridge, flash, due_us = (
        rest.split()
    )
    return Answer(
        tuple(frames.split()),
        int(state),
        int(faults),
        int(last_stop),
        int(mode),
        float(target),
        float(limit),
        int(rejected),
        int(due_us) if event.startswith("poll") else None,
        int(dropped),
        bridge == "1",
        flash == "1",
    )


# --- the emulator -----------------------------------------------------------------------------------------------


class EmulatedReplay:
    """The emulator of one module, which processes events in the form of text."""

    def __init__(self) -> None:
        self.module: ModuleFirmware
        self._readings = ModuleReadings(0, 0, 0)

    def run(self, events: Sequence[str]) -> list[Answer]:
        """Return the answers of the emulator, in order."""
        answers: list[Answer] = []
        for event in events:
            word, *values = event.split()
            match word:
                case "init":
                    self._init(values)
                case "sensors":
                    self._set_sensors([int(value) for value in values])
                case "frame":
                    data = b"" if values[2] == "-" else bytes.fromhex(values[2])
                    self._receive(CanFrame(int(values[1], 16), data), int(values[0]))
                    answers.append(self._make_answer(None))
                case "poll":
                    answers.append(self._make_answer(round(self.module.poll(int(values[0])))))
                case _:
                    raise ValueError(event)
        return answers

    def _init(self, values: Sequence[str]) -> None:
        flash = make_factory_defaults(float(values[2]), float(values[3]))
        self.module = ModuleFirmware(
            int(values[0]),
            int(values[1]),
            ParameterStore(flash),
            HeatLimits(derate_from_c=int(values[4]) / 10, stop_at_c=int(values[5]) / 10),
            min_voltage_v=int(values[6]) / 1000,
            now_us=int(values[7]),
        )

    def _set_sensors(self, values: Sequence[int]) -> None:
        health = self.module.health
        health.sensor_failed = not values[0]
        health.speed_rad_s = values[2] / 1000
        health.voltage_v = values[5] / 1000
        health.current_a = values[6] / 1000
        health.winding_c = values[7] / 10
        health.board_c = values[8] / 10
        health.leak = bool(values[9])
        gyro = [_clamp(Opcode.GYRO, "rate_x", value) for value in values[24:27]]
        acceleration = [
            _clamp(Opcode.ACCELEROMETER, "acceleration_x", value) for value in values[27:30]
        ]
        self._readings = ModuleReadings(
            _clamp(Opcode.JOINT_STATE, "angle", values[1]),
            _clamp(Opcode.JOINT_STATE, "velocity", values[2]),
            _clamp(Opcode.JOINT_STATE, "torque", values[3]),
            bool(values[4]),
            _make_contact(values[11:17]),
            _make_contact(values[17:23]),
            gyro if values[23] else None,
            acceleration if values[23] else None,
            _clamp(Opcode.SHAFT_LOAD, "torque", values[31]) if values[30] else None,
        )

    def _receive(self, frame: CanFrame, now_us: int) -> None:
        """Deliver a frame as `ModuleChain` does, if it is for this module."""
        opcode = parse_opcode(frame.id)
        node = parse_node(frame.id)
        is_for_this_module = node == self.module.node_id
        if frame.id > LAST_ID:
            return
        match opcode:
            case Opcode.SYNC if node == BROADCAST:
                self._receive_sync(frame)
            case Opcode.SET_POINT if is_for_this_module:
                self.module.receive_setpoint(frame, now_us)
            case Opcode.PARAMETER_REQUEST if is_for_this_module:
                self.module.receive(frame, now_us)
            case Opcode.COMMAND | Opcode.EMERGENCY if is_for_this_module or node == BROADCAST:
                self.module.receive(frame, now_us)
            case _:
                pass

    def _receive_sync(self, frame: CanFrame) -> None:
        if len(frame.data) == LENGTHS[Opcode.SYNC]:
            count, _time_us = read_sync(frame.data)
            self.module.handle_sync(count, self._readings)
        elif self.module.state != ModuleState.BOOT:
            # `ModuleChain` counts a rejected Sync, but this replay has no chain.
            self.module.rejected_frame_count += 1

    def _make_answer(self, due_us: int | None) -> Answer:
        module = self.module
        frames = tuple(f"{frame.id:03X}#{frame.data.hex().upper()}" for frame in module.frames)
        module.frames = []
        return Answer(
            frames,
            int(module.state),
            module.faults,
            int(module.last_stop),
            int(module.demand.mode),
            module.demand.target,
            module.demand.torque_limit_nm,
            module.rejected_frame_count,
            due_us,
        )


def _clamp(opcode: Opcode, name: str, value: int) -> int:
    """Return a raw number within the range of its signal."""
    signal = load_layouts()[opcode].signals[name]
    return min(max(value, round(signal.low / signal.scale)), round(signal.high / signal.scale))


def _make_contact(values: Sequence[int]) -> tuple[int, ...]:
    touched, x, y, z, along, bearing = values
    if not touched:
        return (0, 0, 0, 0, 0, 0)
    forces = [_clamp(Opcode.CONTACT, "force_x", force) for force in (x, y, z)]
    return (*forces, _clamp(Opcode.CONTACT, "along", along), bearing, 1)


# --- the comparison ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Difference:
    """The first event that emulator and reference answer differently, and all events up to it."""

    events: list[str]
    emulator: Answer
    reference: Answer

    def __str__(self) -> str:
        return "\n".join(
            [
                f"after these {len(self.events)} events",
                *(f"    {event}" for event in self.events),
                f"the emulator:  {self.emulator}",
                f"the reference: {self.reference}",
            ]
        )


def find_difference(program: Path, events: Sequence[str]) -> Difference | None:
    """Return the first difference between the emulator and the reference firmware; None if they agree."""
    from_emulator = EmulatedReplay().run(events)
    from_reference = run_reference(program, events)
    answered_positions = [i for i, event in enumerate(events) if event.startswith(ANSWERED_EVENTS)]
    for i, emulator, reference in zip(
        answered_positions, from_emulator, from_reference, strict=True
    ):
        if not emulator.agrees_with(reference):
            return Difference(list(events[: i + 1]), emulator, reference)
    return None


def shrink_difference(program: Path, difference: Difference) -> Difference:
    """Remove events from a difference as long as a difference remains, and return the shortest one.

    Longer parts are removed first. The first event, `init`, stays.
    """
    part_length = len(difference.events) // 2
    while part_length >= 1:
        start = 1  # after `init`
        while start < len(difference.events):
            events_without_part = (
                difference.events[:start] + difference.events[start + part_length :]
            )
            shorter = find_difference(program, events_without_part)
            if shorter is None:
                start += part_length
            else:
                difference = shorter
        part_length //= 2
    return difference
