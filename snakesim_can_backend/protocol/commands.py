"""Frames to the modules: setpoints in raw numbers, and commands for changes of the robot's lifecycle.

Pure: returns frames, and the caller sends them. A setpoint that the bus did not accept is replaced by the next;
nothing is ever queued.
"""

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray

from snakesim_can_backend.protocol.codec import Writer, codec
from snakesim_can_backend.protocol.definitions import (
    BROADCAST,
    COMMAND_KEY,
    COUNTS,
    Action,
    EmergencyReason,
    Frame,
    ModuleState,
    Opcode,
    Operation,
    Parameter,
)
from snakesim_hal.backend import SafeSetpoints
from snakesim_hal.wire.messages import LifecycleState

LATCHED: tuple[LifecycleState, ...] = ("fault", "estop")
MAX_RAW = 32767
MAX_LIMIT_RAW = 65535


class SetpointWriter:
    """Makes the setpoint frames of all joints; tracks the next count that each module expects."""

    def __init__(self, joints: int) -> None:
        layout = codec()[Opcode.SET_POINT]
        self._write = layout.writer("mode", "count", "position", "torque_limit")  # the targets share their bits
        self._count = [0] * joints
        scales = [layout.signals[name].scale for name in ("position", "velocity", "torque")]
        self._steps_per_unit = 1.0 / np.array([math.inf, *scales])  # by mode; the bits of a passive one are 0
        self._limit_steps = 1.0 / layout.signals["torque_limit"].scale

    def frames(self, setpoints: SafeSetpoints) -> list[Frame]:
        """One frame a joint, tail to head."""
        modes = np.array(setpoints.mode, dtype=np.intp)
        target = _steps(np.array(setpoints.target) * self._steps_per_unit[modes], -MAX_RAW, MAX_RAW)
        limit = _steps(np.array(setpoints.torque_limit_nm) * self._limit_steps, 0, MAX_LIMIT_RAW)
        rows = zip(setpoints.mode, self._count, target.tolist(), limit.tolist(), strict=True)
        return [self._write(node, row) for node, row in enumerate(rows, start=1)]

    def sent(self, joint: int) -> None:
        """The bus accepted the setpoint of a joint; only then does its module expect the next count."""
        self._count[joint] = (self._count[joint] + 1) % COUNTS


def _steps(values: NDArray[np.float64], low: int, high: int) -> NDArray[np.int64]:
    """The nearest integer steps. Values are finite: the limiter rejects NaN."""
    return np.clip(np.rint(values), low, high).astype(np.int64)


def on_change(before: LifecycleState, now: LifecycleState) -> list[Frame]:
    """Frames to all modules when the robot's lifecycle changes; it may have passed through states in between."""
    if now == before:
        return []
    if now == "estop":
        return [emergency()]
    if before == "armed":
        return [command(Action.STOP if now == "fault" else Action.DISARM)]
    first = [command(Action.CLEAR)] if before in LATCHED and now not in LATCHED else []
    return [*first, command(Action.ARM)] if now == "armed" else first


def reminder(lifecycle: LifecycleState, state: ModuleState, node: int) -> Frame | None:
    """The frame to repeat to a module in an unexpected state, because one may have been lost."""
    match lifecycle, state:
        case "armed", ModuleState.DISARMED:
            return command(Action.ARM, node)
        case "estop", ModuleState.DISARMED | ModuleState.ARMED | ModuleState.STOPPING | ModuleState.FAULT:
            return emergency()
        case (("disarmed" | "fault"), ModuleState.ARMED):
            return command(Action.STOP, node)
    return None


def is_arming(frame: Frame) -> bool:
    """Whether a frame would switch motors on."""
    return frame == command(Action.ARM)


def command(action: Action, node: int = BROADCAST) -> Frame:
    """A Command to one module, or to all."""
    return codec()[Opcode.COMMAND].frame(node, action=action, key=COMMAND_KEY)


def question(node: int) -> Frame:
    """A request for a constant value: its answer comes after all earlier frames of the module."""
    return codec()[Opcode.PARAMETER_REQUEST].frame(node, index=Parameter.TAIL, operation=Operation.READ, value=0.0)


def emergency() -> Frame:
    """Motors off at once, on all modules."""
    return codec()[Opcode.EMERGENCY].frame(BROADCAST, reason=EmergencyReason.HOST)


def sync(count: int, time_us: int) -> Frame:
    """All modules sample and enact now."""
    return _sync_writer()(BROADCAST, (count & 0xFF, time_us & 0xFFFFFFFF))


@cache
def _sync_writer() -> Writer:
    return codec()[Opcode.SYNC].writer("count", "time")
