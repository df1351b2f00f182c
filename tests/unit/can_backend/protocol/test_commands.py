"""Frames of the host: setpoints in raw numbers, and commands when the lifecycle of the robot changes."""

import math
from typing import get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from snakesim_can_backend.protocol import commands
from snakesim_can_backend.protocol.codec import load_layouts
from snakesim_can_backend.protocol.definitions import (
    CanFrame,
    CommandAction,
    ModuleState,
    Opcode,
)
from snakesim_hal.wire.messages import JointMode, LifecycleState
from snakesim_testing.can.frames import decode_signals

LIFECYCLES: tuple[LifecycleState, ...] = get_args(LifecycleState)
TARGET_SIGNALS = {
    JointMode.POSITION: "position",
    JointMode.VELOCITY: "velocity",
    JointMode.TORQUE: "torque",
}


def encode_setpoint(mode: JointMode, target: float, limit_nm: float = 4.0) -> CanFrame:
    """Encode the setpoint of one joint."""
    (frame,) = commands.SetpointWriter(1).encode([mode], np.array([target]), np.array([limit_nm]))
    return frame


# --- setpoints --------------------------------------------------------------------------------------------


@given(st.sampled_from(list(TARGET_SIGNALS)), st.floats(-3.2767, 3.2767), st.floats(0, 65.535))
def test_setpoint_target_and_limit_are_rounded_to_nearest_step(
    mode: JointMode, target: float, limit_nm: float
) -> None:
    sent = decode_signals(encode_setpoint(mode, target, limit_nm))
    step = load_layouts()[Opcode.SET_POINT].signals[TARGET_SIGNALS[mode]].scale
    assert abs(sent[TARGET_SIGNALS[mode]] - target) <= step / 2 * (1 + 1e-9)
    assert abs(sent["torque_limit"] - limit_nm) <= 0.0005 * (1 + 1e-9)


@given(st.sampled_from(list(TARGET_SIGNALS)), st.floats(33, 1e9) | st.just(math.inf), st.booleans())
def test_setpoint_beyond_the_range_is_sent_as_its_end(
    mode: JointMode, magnitude: float, is_negative: bool
) -> None:
    sent = decode_signals(
        encode_setpoint(mode, -magnitude if is_negative else magnitude, 65.6 + magnitude)
    )
    max_target = 32767 * load_layouts()[Opcode.SET_POINT].signals[TARGET_SIGNALS[mode]].scale
    assert sent[TARGET_SIGNALS[mode]] == pytest.approx(-max_target if is_negative else max_target)
    assert sent["torque_limit"] == pytest.approx(65.535)
    assert decode_signals(encode_setpoint(mode, 0.0, -1.0))["torque_limit"] == 0.0


@given(st.floats(-1e6, 1e6))
def test_setpoint_of_passive_joint_has_no_target(target: float) -> None:
    frame = encode_setpoint(JointMode.PASSIVE, target, 0.0)
    assert frame.data[:5] == bytes(5)


def test_setpoint_count_other_than_joint_count_is_refused() -> None:
    with pytest.raises(ValueError):
        commands.SetpointWriter(3).encode([JointMode.PASSIVE] * 2, np.zeros(2), np.zeros(2))


# --- changes of the robot's lifecycle ----------------------------------------------------------------------

CLEAR = commands.make_command(CommandAction.CLEAR)
ARM = commands.make_command(CommandAction.ARM)
STOP = commands.make_command(CommandAction.STOP)
DISARM = commands.make_command(CommandAction.DISARM)
EMERGENCY = commands.make_emergency()
TRANSITION_FRAMES: dict[tuple[LifecycleState, LifecycleState], list[CanFrame]] = {
    ("disarmed", "armed"): [ARM],
    ("disarmed", "fault"): [],
    ("disarmed", "estop"): [EMERGENCY],
    ("armed", "disarmed"): [DISARM],
    ("armed", "fault"): [STOP],
    ("armed", "estop"): [EMERGENCY],
    ("fault", "disarmed"): [CLEAR],
    ("fault", "armed"): [CLEAR, ARM],
    ("fault", "estop"): [EMERGENCY],
    ("estop", "disarmed"): [CLEAR],
    ("estop", "armed"): [CLEAR, ARM],
    ("estop", "fault"): [],
}


@pytest.mark.parametrize("before", LIFECYCLES)
@pytest.mark.parametrize("after", LIFECYCLES)
def test_commands_on_state_change_address_all_modules(
    before: LifecycleState, after: LifecycleState
) -> None:
    assert commands.make_transition_frames(before, after) == TRANSITION_FRAMES.get(
        (before, after), []
    )
    assert before == after or (before, after) in TRANSITION_FRAMES


@pytest.mark.parametrize("lifecycle", LIFECYCLES)
@pytest.mark.parametrize("state", list(ModuleState))
def test_commands_repeat_state_to_a_module_that_differs(
    lifecycle: LifecycleState, state: ModuleState
) -> None:
    expected: CanFrame | None = None
    if (lifecycle, state) == ("armed", ModuleState.DISARMED):
        expected = commands.make_command(CommandAction.ARM, 3)
    elif lifecycle == "estop" and state not in (ModuleState.EMERGENCY, ModuleState.BOOT):
        expected = EMERGENCY
    elif lifecycle in ("disarmed", "fault") and state == ModuleState.ARMED:
        expected = commands.make_command(CommandAction.STOP, 3)
    assert commands.make_repeated_command(lifecycle, state, 3) == expected


# --- frames ------------------------------------------------------------------------------------------------


@given(st.integers(0, 2**40), st.integers(0, 2**50))
def test_sync_contains_count_and_time_modulo_their_ranges(count: int, time_us: int) -> None:
    frame = commands.make_sync(count, time_us)
    assert frame.id == 0x080
    assert decode_signals(frame) == {"count": count % 256, "time": time_us % 2**32}
