"""What goes out: setpoints in raw numbers, and what modules are told when the robot's lifecycle changes."""

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
TARGET = {
    JointMode.POSITION: "position",
    JointMode.VELOCITY: "velocity",
    JointMode.TORQUE: "torque",
}


def one(mode: JointMode, target: float, limit_nm: float = 4.0) -> CanFrame:
    (frame,) = commands.SetpointWriter(1).encode([mode], np.array([target]), np.array([limit_nm]))
    return frame


# --- setpoints --------------------------------------------------------------------------------------------


@given(st.sampled_from(list(TARGET)), st.floats(-3.2767, 3.2767), st.floats(0, 65.535))
def test_targets_and_limits_are_rounded_to_the_nearest_step(
    mode: JointMode, target: float, limit_nm: float
) -> None:
    said = decode_signals(one(mode, target, limit_nm))
    step = load_layouts()[Opcode.SET_POINT].signals[TARGET[mode]].scale
    assert abs(said[TARGET[mode]] - target) <= step / 2 * (1 + 1e-9)
    assert abs(said["torque_limit"] - limit_nm) <= 0.0005 * (1 + 1e-9)


@given(st.sampled_from(list(TARGET)), st.floats(33, 1e9) | st.just(math.inf), st.booleans())
def test_what_is_beyond_the_range_is_sent_as_its_end(
    mode: JointMode, beyond: float, negative: bool
) -> None:
    said = decode_signals(one(mode, -beyond if negative else beyond, 65.6 + beyond))
    most = 32767 * load_layouts()[Opcode.SET_POINT].signals[TARGET[mode]].scale
    assert said[TARGET[mode]] == pytest.approx(-most if negative else most)
    assert said["torque_limit"] == pytest.approx(65.535)
    assert decode_signals(one(mode, 0.0, -1.0))["torque_limit"] == 0.0


@given(st.floats(-1e6, 1e6))
def test_a_passive_joint_gets_no_target(target: float) -> None:
    frame = one(JointMode.PASSIVE, target, 0.0)
    assert frame.data[:5] == bytes(5)


def test_joints_and_set_points_must_be_as_many() -> None:
    with pytest.raises(ValueError):
        commands.SetpointWriter(3).encode([JointMode.PASSIVE] * 2, np.zeros(2), np.zeros(2))


# --- changes of the robot's lifecycle ----------------------------------------------------------------------

CLEAR, ARM, STOP, DISARM = (
    commands.make_command(a)
    for a in (CommandAction.CLEAR, CommandAction.ARM, CommandAction.STOP, CommandAction.DISARM)
)
EMERGENCY = commands.make_emergency()
TOLD: dict[tuple[LifecycleState, LifecycleState], list[CanFrame]] = {
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
@pytest.mark.parametrize("now", LIFECYCLES)
def test_commands_on_state_change_address_all_modules(
    before: LifecycleState, now: LifecycleState
) -> None:
    assert commands.make_transition_frames(before, now) == TOLD.get((before, now), [])
    assert before == now or (before, now) in TOLD


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
def test_a_sync_carries_count_and_time_modulo_their_ranges(count: int, time_us: int) -> None:
    frame = commands.make_sync(count, time_us)
    assert frame.id == 0x080
    assert decode_signals(frame) == {"count": count % 256, "time": time_us % 2**32}
