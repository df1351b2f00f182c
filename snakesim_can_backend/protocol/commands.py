"""Frames to the modules: setpoints in raw numbers, and commands for changes of the robot's lifecycle.

This module is pure: it returns frames, and the caller sends them. A setpoint that the bus did not accept is replaced by
the next one; nothing is ever queued.
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
    CanFrame,
    CommandAction,
    EmergencyReason,
    ModuleParameter,
    ModuleState,
    Opcode,
    ParameterOperation,
)
from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import JointMode, LifecycleState

# States that a robot leaves only by a reset.
LATCHED_LIFECYCLE_STATES: tuple[LifecycleState, ...] = ("fault", "estop")
# Of a signed number of 16 bits; -32768 is not used, so that the range is symmetric.
MAX_TARGET_RAW = 32767
MAX_TORQUE_LIMIT_RAW = 65535  # of an unsigned number of 16 bits
SYNC_COUNT_MASK = 0xFF
SYNC_TIME_MASK = 0xFFFFFFFF


class SetpointWriter:
    """Makes the setpoint frames of all joints, and tracks the counter that each module expects next."""

    def __init__(self, joint_count: int) -> None:
        layout = load_layouts()[Opcode.SET_POINT]
        # Position, velocity and torque share their bits, so that writing one of them writes the target of every mode.
        self._write = layout.make_writer("mode", "count", "position", "torque_limit")
        self._count = [0] * joint_count
        scales = [layout.signals[name].scale for name in ("position", "velocity", "torque")]
        # By mode; a passive joint has no target.
        self._steps_per_unit = 1.0 / np.array([math.inf, *scales])
        self._limit_steps_per_nm = 1.0 / layout.signals["torque_limit"].scale

    def encode(self, modes: list[JointMode], targets: Floats, limits_nm: Floats) -> list[CanFrame]:
        """Return one frame a joint, tail to head.

        Args:
            modes: Control mode of every joint.
            targets: (n_joints,) rad, rad/s or N·m at the module's shaft, depending on the mode.
            limits_nm: (n_joints,) torque limits at the module's shaft.
        """
        mode_indices = np.array(modes, dtype=np.intp)
        targets_raw = _round_steps(
            targets * self._steps_per_unit[mode_indices], -MAX_TARGET_RAW, MAX_TARGET_RAW
        )
        limits_raw = _round_steps(limits_nm * self._limit_steps_per_nm, 0, MAX_TORQUE_LIMIT_RAW)
        rows = zip(modes, self._count, targets_raw.tolist(), limits_raw.tolist(), strict=True)
        return [self._write(node, row) for node, row in enumerate(rows, start=1)]

    def confirm_sent(self, joint_index: int) -> None:
        """Advance the counter of a joint. Call it only for setpoints that the bus has accepted."""
        self._count[joint_index] = (self._count[joint_index] + 1) % COUNTER_MODULUS


def _round_steps(values: NDArray[np.float64], low: int, high: int) -> NDArray[np.int64]:
    """Return the nearest integer steps within a range. Values are finite, because the limiter rejects NaN."""
    return np.clip(np.rint(values), low, high).astype(np.int64)


def make_transition_frames(before: LifecycleState, now: LifecycleState) -> list[CanFrame]:
    """Return the frames to all modules when the robot's lifecycle changes.

    The lifecycle may have passed through other states between `before` and `now`, within one control cycle.

    Args:
        before: Lifecycle state in the control cycle before.
        now: Current lifecycle state.

    Returns:
        The frames in the order in which they have to be sent; empty if no command is needed.
    """
    if now == before:
        return []
    if now == "estop":
        return [make_emergency()]
    if before == "armed":
        # CLEAR is for modules in a latched state, and neither STOP nor DISARM leads to one.
        action = CommandAction.STOP if now == "fault" else CommandAction.DISARM
        return [make_command(action)]
    frames: list[CanFrame] = []
    if before in LATCHED_LIFECYCLE_STATES and now not in LATCHED_LIFECYCLE_STATES:
        frames.append(make_command(CommandAction.CLEAR))
    if now == "armed":
        frames.append(make_command(CommandAction.ARM))
    return frames


def make_repeated_command(
    lifecycle: LifecycleState, state: ModuleState, node_id: int
) -> CanFrame | None:
    """Return the frame to repeat to a module in an unexpected state, because an earlier one may have been lost."""
    match lifecycle, state:
        case "armed", ModuleState.DISARMED:
            return make_command(CommandAction.ARM, node_id)
        case (
            "estop",
            ModuleState.DISARMED | ModuleState.ARMED | ModuleState.STOPPING | ModuleState.FAULT,
        ):
            return make_emergency()
        case (("disarmed" | "fault"), ModuleState.ARMED):
            return make_command(CommandAction.STOP, node_id)
    return None


def is_arm_command(frame: CanFrame) -> bool:
    """Return whether a frame would switch the motors of all modules on."""
    return frame == make_command(CommandAction.ARM)


def make_command(action: CommandAction, node_id: int = BROADCAST) -> CanFrame:
    """Return a Command to one module, or to all."""
    return load_layouts()[Opcode.COMMAND].encode(node_id, action=action, key=COMMAND_KEY)


def make_query(node_id: int) -> CanFrame:
    """Return a request for a constant parameter. Its answer comes after all earlier frames of the module."""
    layout = load_layouts()[Opcode.PARAMETER_REQUEST]
    return layout.encode(
        node_id, index=ModuleParameter.TAIL, operation=ParameterOperation.READ, value=0.0
    )


def make_emergency() -> CanFrame:
    """Return the frame that switches the motors of all modules off at once."""
    return load_layouts()[Opcode.EMERGENCY].encode(BROADCAST, reason=EmergencyReason.HOST)


def make_sync(count: int, time_us: int) -> CanFrame:
    """Return the frame at which all modules sample their sensors and then follow their newest setpoints.

    Args:
        count: Number of the Sync; the frame has its lowest 8 bits.
        time_us: Time of the host; the frame has its lowest 32 bits.
    """
    return _sync_writer()(BROADCAST, (count & SYNC_COUNT_MASK, time_us & SYNC_TIME_MASK))


@cache
def _sync_writer() -> Writer:
    return load_layouts()[Opcode.SYNC].make_writer("count", "time")
