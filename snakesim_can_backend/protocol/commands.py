"""Frames to the modules: setpoints in raw numbers, and commands for changes of the robot's lifecycle.

Pure: returns frames, and the caller sends them. A setpoint that the bus did not accept is replaced by the next;
nothing is ever queued.
"""

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray

from snakesim_can_backend.protocol.codec import Writer, load_layouts
from snakesim_can_backend.protocol.definitions import (
    BROADCAST,
    COMMAND_KEY,
    COUNTER_MODULUS,
    CommandAction,
    EmergencyReason,
    Frame,
    ModuleParameter,
    ModuleState,
    Opcode,
    ParameterOperation,
)
from snakesim_hal.backend import Setpoints
from snakesim_hal.wire.messages import LifecycleState

LATCHED: tuple[LifecycleState, ...] = ("fault", "estop")
MAX_RAW = 32767
MAX_LIMIT_RAW = 65535


class SetpointWriter:
    """Makes the setpoint frames of all joints; tracks the next count that each module expects."""

    def __init__(self, joints: int) -> None:
        layout = load_layouts()[Opcode.SET_POINT]
        self._write = layout.make_writer("mode", "count", "position", "torque_limit")  # the targets share their bits
        self._count = [0] * joints
        scales = [layout.signals[name].scale for name in ("position", "velocity", "torque")]
        self._steps_per_unit = 1.0 / np.array([math.inf, *scales])  # by mode; the bits of a passive one are 0
        self._limit_steps = 1.0 / layout.signals["torque_limit"].scale

    def encode(self, setpoints: Setpoints) -> list[Frame]:
        """One frame a joint, tail to head."""
        modes = np.array(setpoints.mode, dtype=np.intp)
        target = _steps(np.array(setpoints.target) * self._steps_per_unit[modes], -MAX_RAW, MAX_RAW)
        limit = _steps(np.array(setpoints.torque_limit_nm) * self._limit_steps, 0, MAX_LIMIT_RAW)
        rows = zip(setpoints.mode, self._count, target.tolist(), limit.tolist(), strict=True)
        return [self._write(node, row) for node, row in enumerate(rows, start=1)]

    def confirm_sent(self, joint: int) -> None:
        """The bus accepted the setpoint of a joint; only then does its module expect the next count."""
        self._count[joint] = (self._count[joint] + 1) % COUNTER_MODULUS


def _steps(values: NDArray[np.float64], low: int, high: int) -> NDArray[np.int64]:
    """The nearest integer steps. Values are finite: the limiter rejects NaN."""
    return np.clip(np.rint(values), low, high).astype(np.int64)


def make_transition_frames(before: LifecycleState, now: LifecycleState) -> list[Frame]:
    """Frames to all modules when the robot's lifecycle changes; it may have passed through states in between."""
    if now == before:
        return []
    if now == "estop":
        return [make_emergency()]
    if before == "armed":
        return [make_command(CommandAction.STOP if now == "fault" else CommandAction.DISARM)]
    first = [make_command(CommandAction.CLEAR)] if before in LATCHED and now not in LATCHED else []
    return [*first, make_command(CommandAction.ARM)] if now == "armed" else first


def make_reminder(lifecycle: LifecycleState, state: ModuleState, node: int) -> Frame | None:
    """The frame to repeat to a module in an unexpected state, because one may have been lost."""
    match lifecycle, state:
        case "armed", ModuleState.DISARMED:
            return make_command(CommandAction.ARM, node)
        case "estop", ModuleState.DISARMED | ModuleState.ARMED | ModuleState.STOPPING | ModuleState.FAULT:
            return make_emergency()
        case (("disarmed" | "fault"), ModuleState.ARMED):
            return make_command(CommandAction.STOP, node)
    return None


def is_arm_command(frame: Frame) -> bool:
    """Whether a frame would switch motors on."""
    return frame == make_command(CommandAction.ARM)


def make_command(action: CommandAction, node: int = BROADCAST) -> Frame:
    """A Command to one module, or to all."""
    return load_layouts()[Opcode.COMMAND].encode(node, action=action, key=COMMAND_KEY)


def make_query(node: int) -> Frame:
    """A request for a constant value: its answer comes after all earlier frames of the module."""
    return load_layouts()[Opcode.PARAMETER_REQUEST].encode(
        node, index=ModuleParameter.TAIL, operation=ParameterOperation.READ, value=0.0
    )


def make_emergency() -> Frame:
    """Motors off at once, on all modules."""
    return load_layouts()[Opcode.EMERGENCY].encode(BROADCAST, reason=EmergencyReason.HOST)


def make_sync(count: int, time_us: int) -> Frame:
    """All modules sample and enact now."""
    return _sync_writer()(BROADCAST, (count & 0xFF, time_us & 0xFFFFFFFF))


@cache
def _sync_writer() -> Writer:
    return load_layouts()[Opcode.SYNC].make_writer("count", "time")
