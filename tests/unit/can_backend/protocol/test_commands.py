"""What goes out: set-points in raw numbers, and what modules are told when the robot's lifecycle changes."""

import math
from typing import get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

from snakesim_can_backend.protocol import commands
from snakesim_can_backend.protocol.codec import codec
from snakesim_can_backend.protocol.definitions import (
    BROADCAST,
    COMMAND_KEY,
    COUNTS,
    Action,
    Frame,
    ModuleState,
    Opcode,
    intact,
    node_of,
    opcode_of,
)
from snakesim_hal.backend import SetPoints
from snakesim_hal.wire.messages import LifecycleState, Mode

LIFECYCLES: tuple[LifecycleState, ...] = get_args(LifecycleState)
TARGET = {Mode.POSITION: "position", Mode.VELOCITY: "velocity", Mode.TORQUE: "torque"}


def values(frame: Frame) -> dict[str, float]:
    return dict(codec()[Opcode(opcode_of(frame.id))].values(frame.data))


def one(mode: Mode, target: float, limit_nm: float = 4.0) -> Frame:
    (frame,) = commands.SetPointWriter(1).frames(SetPoints([mode], [target], [limit_nm]))
    return frame


# --- set-points --------------------------------------------------------------------------------------------


def test_the_frame_is_that_of_the_document() -> None:
    writer = commands.SetPointWriter(5)
    for _ in range(3):
        writer.sent(4)
    frames = writer.frames(SetPoints([Mode.POSITION] * 5, [-0.5] * 5, [7.0] * 5))
    assert frames[4] == Frame(0x0C5, bytes.fromhex("3178EC581BF4"))


def test_every_joint_has_its_own_mode_target_and_limit() -> None:
    modes = [Mode.TORQUE, Mode.PASSIVE, Mode.POSITION, Mode.VELOCITY]
    frames = commands.SetPointWriter(4).frames(SetPoints(modes, [-1.5, 0.0, 0.25, 2.0], [1.0, 0.0, 3.0, 4.0]))
    assert [node_of(frame.id) for frame in frames] == [1, 2, 3, 4]
    assert {opcode_of(frame.id) for frame in frames} == {Opcode.SET_POINT} and all(map(intact, frames))
    read = [values(frame) for frame in frames]
    assert [row["mode"] for row in read] == modes
    assert (read[0]["torque"], read[2]["position"], read[3]["velocity"]) == pytest.approx((-1.5, 0.25, 2.0))
    assert [row["torque_limit"] for row in read] == pytest.approx([1.0, 0.0, 3.0, 4.0])


@given(st.sampled_from(list(TARGET)), st.floats(-3.2767, 3.2767), st.floats(0, 65.535))
def test_targets_and_limits_are_rounded_to_the_nearest_step(mode: Mode, target: float, limit_nm: float) -> None:
    read = values(one(mode, target, limit_nm))
    step = codec()[Opcode.SET_POINT].signals[TARGET[mode]].scale
    assert abs(read[TARGET[mode]] - target) <= step / 2 * (1 + 1e-9)
    assert abs(read["torque_limit"] - limit_nm) <= 0.0005 * (1 + 1e-9)


@given(st.sampled_from(list(TARGET)), st.floats(33, 1e9) | st.just(math.inf), st.booleans())
def test_what_is_beyond_the_range_is_sent_as_its_end(mode: Mode, beyond: float, negative: bool) -> None:
    read = values(one(mode, -beyond if negative else beyond, 65.6 + beyond))
    most = 32767 * codec()[Opcode.SET_POINT].signals[TARGET[mode]].scale
    assert read[TARGET[mode]] == pytest.approx(-most if negative else most)
    assert read["torque_limit"] == pytest.approx(65.535)
    assert values(one(mode, 0.0, -1.0))["torque_limit"] == 0.0


@given(st.floats(-1e6, 1e6))
def test_a_passive_joint_gets_no_target(target: float) -> None:
    frame = one(Mode.PASSIVE, target, 0.0)
    assert frame.data[:5] == bytes(5)


def test_a_count_goes_on_only_when_its_set_point_was_sent() -> None:
    writer = commands.SetPointWriter(2)
    still = SetPoints([Mode.PASSIVE] * 2, [0.0] * 2, [0.0] * 2)
    for i in range(2 * COUNTS + 3):
        assert [values(frame)["count"] for frame in writer.frames(still)] == [i % COUNTS, 0]
        assert writer.frames(still) == writer.frames(still)
        writer.sent(0)


def test_joints_and_set_points_must_be_as_many() -> None:
    with pytest.raises(ValueError):
        commands.SetPointWriter(3).frames(SetPoints([Mode.PASSIVE] * 2, [0.0] * 2, [0.0] * 2))


# --- changes of the robot's lifecycle ----------------------------------------------------------------------

CLEAR, ARM, STOP, DISARM = (commands.command(a) for a in (Action.CLEAR, Action.ARM, Action.STOP, Action.DISARM))
EMERGENCY = commands.emergency()
TOLD: dict[tuple[LifecycleState, LifecycleState], list[Frame]] = {
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
def test_what_all_modules_are_told_at_a_change(before: LifecycleState, now: LifecycleState) -> None:
    assert commands.on_change(before, now) == TOLD.get((before, now), [])
    assert before == now or (before, now) in TOLD


@pytest.mark.parametrize("lifecycle", LIFECYCLES)
@pytest.mark.parametrize("state", list(ModuleState))
def test_what_a_module_is_reminded_of(lifecycle: LifecycleState, state: ModuleState) -> None:
    expected: Frame | None = None
    if (lifecycle, state) == ("armed", ModuleState.DISARMED):
        expected = commands.command(Action.ARM, 3)
    elif lifecycle == "estop" and state not in (ModuleState.EMERGENCY, ModuleState.BOOT):
        expected = EMERGENCY
    elif lifecycle in ("disarmed", "fault") and state == ModuleState.ARMED:
        expected = commands.command(Action.STOP, 3)
    assert commands.reminder(lifecycle, state, 3) == expected


# --- frames ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("action", list(Action))
@pytest.mark.parametrize("node", [BROADCAST, 5])
def test_a_command_has_key_and_checksum(action: Action, node: int) -> None:
    frame = commands.command(action, node)
    assert (opcode_of(frame.id), node_of(frame.id)) == (Opcode.COMMAND, node) and intact(frame)
    read = values(frame)
    assert (read["action"], read["key"]) == (action, COMMAND_KEY)


@given(st.integers(0, 2**40), st.integers(0, 2**50))
def test_a_sync_carries_count_and_time_modulo_their_ranges(count: int, time_us: int) -> None:
    frame = commands.sync(count, time_us)
    assert frame.id == 0x080
    assert values(frame) == {"count": count % 256, "time": time_us % 2**32}
