"""What is taken of the modules' frames, and what is noticed of those that are not as they should be."""

import copy

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from snakesim_can_backend.driver.reports import LATE_SYNCS, Reading
from snakesim_can_backend.protocol.codec import codec
from snakesim_can_backend.protocol.commands import command
from snakesim_can_backend.protocol.definitions import (
    LAST_NODE,
    Action,
    Frame,
    LastStop,
    ModuleState,
    Opcode,
    frame_id,
    intact,
    node_of,
    opcode_of,
)
from tests.unit.can_backend.frames import (
    accelerometer,
    answer,
    begin,
    contact,
    gyro,
    health,
    heartbeat,
    joint_state,
    spoilt,
    syncs,
)

JOINTS = 3


def reading(syncs_before: int = 5) -> Reading:
    made = Reading(JOINTS)
    syncs(made, syncs_before)
    return made


def angles(made: Reading) -> list[float]:
    return made.joints()[0].tolist()


# --- states ------------------------------------------------------------------------------------------------


def test_joints_are_in_si_units_tail_to_head() -> None:
    made = Reading(JOINTS)
    begin(made)
    for node in (3, 1, 2):
        made.take(joint_state(node, 0, 0.1 * node, velocity=-node, torque=0.5 * node, state=ModuleState.ARMED))
    expected = [[0.1, 0.2, 0.3], [-1.0, -2.0, -3.0], [0.5, 1.0, 1.5]]
    assert made.joints().shape == (3, JOINTS) and np.allclose(made.joints(), expected)
    assert [module.sync for module in made.modules] == [0, 0, 0] and made.complete
    assert {module.state for module in made.modules} == {ModuleState.ARMED}


def test_joints_that_were_not_heard_yet_are_no_obstacle_to_the_others() -> None:
    made = Reading(JOINTS)
    syncs(made, 1, [2])
    assert angles(made) == pytest.approx([0.0, 0.1, 0.0]) and made.modules[0].sync == -1


@pytest.mark.parametrize("late", range(1, LATE_SYNCS + 1))
def test_a_late_state_is_taken_with_the_sync_that_it_answers(late: int) -> None:
    made = reading()
    syncs(made, late + 1, [1, 3])
    made.take(joint_state(2, made.sync - late, 0.7))
    assert made.modules[1].sync == made.sync - late and angles(made)[1] == pytest.approx(0.7)
    assert made.modules[1].wrong_counts == 0
    assert made.states_missing == 1, "the newest Sync is not answered by it"


def test_states_three_syncs_late_are_taken_and_those_of_four_have_a_wrong_count() -> None:
    for late, taken in ((3, True), (4, False)):
        made = reading(2)
        syncs(made, 5, [1, 3])
        made.take(joint_state(2, made.sync - late, 0.9))
        assert (angles(made)[1] == pytest.approx(0.9)) is taken
        assert made.modules[1].sync == (made.sync - 3 if taken else 1)
        assert made.modules[1].wrong_counts == (not taken)


def test_an_older_state_never_replaces_a_newer_one() -> None:
    made = reading()
    begin(made)
    made.take(joint_state(2, made.sync, 0.5))
    made.take(joint_state(2, made.sync - 1, -0.5))
    assert angles(made)[1] == pytest.approx(0.5) and made.modules[1].sync == made.sync
    assert made.modules[1].twice == 0, "late is not twice"


def test_counts_go_round_and_syncs_do_not() -> None:
    made = Reading(JOINTS)
    syncs(made, 300)
    assert made.sync == 299 and {module.sync for module in made.modules} == {299}
    assert not any(module.wrong_counts or module.repeats for module in made.modules)


def test_wrong_counts_are_counted_in_a_row_and_a_good_state_ends_them() -> None:
    made = reading()
    for expected in (1, 2):
        begin(made)
        made.take(joint_state(2, made.sync + 7))
        assert made.modules[1].wrong_counts == expected
    begin(made)
    answer(made)
    assert made.modules[1].wrong_counts == 0


def test_corrupt_states_are_dropped_and_counted_in_a_row() -> None:
    made = reading()
    for expected in (1, 2):
        begin(made)
        made.take(spoilt(joint_state(2, made.sync, 0.9)))
        assert made.modules[1].corrupt == expected and angles(made)[1] == pytest.approx(0.1)
        assert made.modules[1].sync == made.sync - expected and not made.complete
    begin(made)
    answer(made, angle=0.2)
    assert made.modules[1].corrupt == 0 and angles(made)[1] == pytest.approx(0.2)


def test_a_state_under_another_nodes_id_is_corrupt() -> None:
    made = reading()
    begin(made)
    made.take(Frame(frame_id(Opcode.JOINT_STATE, 3), joint_state(2, made.sync, 0.9).data))
    assert made.modules[2].corrupt == 1 and 0.9 not in angles(made)


def test_a_frozen_module_repeats_its_count() -> None:
    made = reading()
    frozen = joint_state(2, made.sync)
    for expected in (1, 2, 3, 4):
        begin(made)
        made.take(frozen)
        assert made.modules[1].repeats == expected
    begin(made)
    answer(made)
    assert made.modules[1].repeats == 0


def test_two_answers_to_one_sync_are_counted_once_a_sync_and_in_a_row() -> None:
    made = reading()
    module = made.modules[1]
    for expected in (1, 2, 3):
        begin(made)
        answer(made, [1, 2, 2, 2, 3])
        assert module.answered_twice(made.sync) == expected
    begin(made)
    assert module.answered_twice(made.sync) == 3, "this Sync may still be answered twice"
    answer(made)
    begin(made)
    assert module.answered_twice(made.sync) == 0
    answer(made, [1, 2, 2, 3])
    assert module.answered_twice(made.sync) == 1


def test_an_unknown_state_is_a_fault() -> None:
    made = reading()
    begin(made)
    write = codec()[Opcode.JOINT_STATE].writer("angle", "velocity", "torque", "count", "state", "derated")
    made.take(write(2, (0, 0, 0, made.sync, 7, 0)))
    assert made.modules[1].state == ModuleState.FAULT
    beat = codec()[Opcode.HEARTBEAT].writer("state", "last_stop", "uptime")
    made.take(beat(3, (15, 200, 1)))
    assert made.modules[2].state == ModuleState.FAULT and made.modules[2].last_stop == LastStop.NONE


# --- who is waited for -------------------------------------------------------------------------------------


def test_it_is_complete_when_everybody_has_answered() -> None:
    made = reading()
    begin(made)
    for node in (1, 2):
        answer(made, [node])
        assert not made.complete
    answer(made, [2])
    assert not made.complete, "an answer that comes twice is not somebody else's"
    answer(made, [3])
    assert made.complete


def test_forces_are_waited_for_at_the_syncs_that_ask_for_them() -> None:
    made = reading()
    begin(made, contacts=True, tail=True)
    answer(made)
    for node in (1, 2, 3):
        assert not made.complete
        made.take(contact(node, made.sync))
    made.take(contact(3, made.sync))
    assert not made.complete, "the tail's own is missing"
    made.take(contact(1, made.sync, tail=True))
    assert made.complete
    begin(made, contacts=True)
    answer(made)
    for node in (1, 2, 3):
        made.take(contact(node, made.sync))
    assert made.complete


def test_who_has_not_answered_for_long_is_not_waited_for() -> None:
    made = reading()
    syncs(made, LATE_SYNCS, [1, 3])
    begin(made, contacts=True, tail=True)
    answer(made, [1, 3])
    assert not made.complete and made.states_missing == 1, "three Syncs are not long"
    begin(made, contacts=True, tail=True)
    answer(made, [1, 3])
    for node in (1, 3):
        made.take(contact(node, made.sync))
    made.take(contact(1, made.sync, tail=True))
    assert made.complete


def test_without_the_tail_nobody_waits_for_its_second_link() -> None:
    made = reading()
    syncs(made, LATE_SYNCS + 1, [2, 3])
    begin(made, contacts=True, tail=True)
    assert (made.states_missing, made.contacts_missing) == (2, 2)


def test_who_was_never_heard_is_waited_for() -> None:
    made = Reading(JOINTS)
    syncs(made, 10, [1, 3])
    begin(made)
    answer(made, [1, 3])
    assert not made.complete


def test_who_comes_back_does_not_stand_for_another() -> None:
    made = reading()
    syncs(made, 10, [1, 3])
    begin(made, contacts=True)
    answer(made, [1, 2])
    made.take(contact(1, made.sync))
    made.take(contact(2, made.sync))
    assert (made.states_missing, made.contacts_missing) == (1, 1)
    answer(made, [3])
    made.take(contact(3, made.sync))
    assert made.complete
    begin(made)
    assert made.states_missing == JOINTS


# --- forces, IMUs, health ----------------------------------------------------------------------------------


def test_forces_belong_to_the_link_in_front_and_the_tails_own_to_link_0() -> None:
    made = reading()
    begin(made, contacts=True, tail=True)
    made.take(contact(1, made.sync, tail=True, force_x=1.0))
    made.take(contact(1, made.sync, force_y=2.0, along=0.05))
    made.take(contact(2, made.sync, touched=False, force_z=3.0))
    made.take(contact(3, made.sync, force_z=4.0, bearing=0.0))
    touched = made.links_touched()
    assert [link for link, _ in touched] == [0, 1, 3]
    assert [list(raw) for _, raw in touched] == [[20, 0, 0, 0, 0], [0, 40, 0, 100, 0], [0, 0, 80, 0, 0]]


def test_forces_of_another_sync_do_not_count_and_old_ones_are_forgotten() -> None:
    made = reading()
    begin(made, contacts=True)
    made.take(contact(2, made.sync - 1, force_x=9.0))
    assert made.links_touched() == [] and made.contacts_missing == JOINTS
    made.take(contact(2, made.sync, force_x=1.0))
    made.take(contact(2, made.sync, force_x=5.0))
    assert [raw[0] for _, raw in made.links_touched()] == [20], "the first counts"
    assert made.contacts_missing == JOINTS - 1
    begin(made, contacts=False)
    assert len(made.links_touched()) == 1
    begin(made, contacts=True)
    assert made.links_touched() == []


def test_an_imu_is_told_once_and_whole() -> None:
    made = reading()
    made.take(gyro(2, 7, 1.0))
    assert made.imus() == []
    made.take(accelerometer(2, 7, 9.81))
    assert [(link, list(rates), list(force)) for link, rates, force in made.imus()] == [(2, [1000, 0, 0], [0, 0, 981])]
    assert made.imus() == []


def test_an_imus_halves_are_of_one_sync() -> None:
    made = reading()
    made.take(gyro(2, 7, 1.0))
    made.take(accelerometer(2, 27, 9.81))  # between them two frames were lost
    assert made.imus() == []
    made.take(gyro(2, 47, 2.0))
    made.take(accelerometer(2, 47, 9.81))
    assert [list(rates) for _, rates, _ in made.imus()] == [[2000, 0, 0]]


def test_health_and_shaft_load_are_kept() -> None:
    made = reading()
    made.take(health(3, voltage=24.0, current=-1.0, motor_temperature=50, board_temperature=30, leak=1))
    made.take(codec()[Opcode.SHAFT_LOAD].frame(2, torque=-1.5))
    assert made.health() == [None, None, (24000, -1000, 90, 70, 1)]
    assert made.shaft_raw == [None, -1500, None]


# --- heartbeats --------------------------------------------------------------------------------------------


def test_an_uptime_that_goes_back_and_on_from_there_is_a_restart() -> None:
    made = reading()
    for uptime_s, restarts in (
        (5.0, 0),
        (5.1, 0),
        (5.1, 0),
        (0.1, 0),
        (0.2, 1),
        (0.3, 1),
        (0.1, 1),
        (0.1, 2),
        (0.2, 2),
    ):
        made.take(heartbeat(2, uptime_s))
        assert made.modules[1].restarts == restarts, uptime_s
        assert made.modules[1].uptime_ms == round(uptime_s * 1000)
    assert made.modules[0].restarts == 0


def test_two_clocks_in_turn_are_two_modules_and_no_restart() -> None:
    made = reading()
    for i in range(20):
        made.take(heartbeat(2, 50.0 + 0.1 * i))
        made.take(heartbeat(2, 0.1 * i))
    assert made.modules[1].restarts == 0


def test_a_heartbeat_that_comes_late_is_no_restart() -> None:
    made = reading()
    for uptime_s in (5.0, 5.2, 5.1, 5.3, 5.4):
        made.take(heartbeat(2, uptime_s))
    assert made.modules[1].restarts == 0


def test_a_heartbeat_tells_state_faults_and_reason() -> None:
    made = reading()
    made.take(heartbeat(2, 1.0, ModuleState.FAULT, last_stop=LastStop.LEAK, fault_leak=1, fault_voltage=1))
    module = made.modules[1]
    assert (module.state, module.last_stop) == (ModuleState.FAULT, LastStop.LEAK)
    assert module.fault_names() == ["leak", "voltage"] and module.needs_clearing
    assert module.heartbeat_sync == made.sync
    made.take(heartbeat(2, 1.1))
    assert module.fault_names() == [] and not module.needs_clearing


@pytest.mark.parametrize("state", [ModuleState.FAULT, ModuleState.EMERGENCY])
def test_a_latched_state_without_a_reason_needs_clearing_after_three_syncs(state: ModuleState) -> None:
    made = reading()
    for needed in (False, False, True):
        syncs(made, 1, state=state)
        assert made.modules[0].needs_clearing is needed
    syncs(made, 1, state=ModuleState.DISARMED)
    assert not made.modules[0].needs_clearing


# --- others ------------------------------------------------------------------------------------------------


def test_frames_of_another_length_are_counted_and_change_nothing() -> None:
    made = reading()
    before = copy.deepcopy(made.modules)
    good = [joint_state(2, made.sync), heartbeat(2, 0.0), contact(2, 0), gyro(2, 0, 0.0), health(2)]
    for i, frame in enumerate(good):
        made.take(Frame(frame.id, frame.data[:-1]))
        made.take(Frame(frame.id, b""))
        assert made.malformed == 2 * (i + 1)
    before[1].frames = made.modules[1].frames
    assert made.modules == before and made.health() == [None] * JOINTS


def test_frames_are_counted_for_each_module_and_tick() -> None:
    made = reading()
    begin(made)
    identity = codec()[Opcode.IDENTITY].frame(2, serial=1)
    for frame in (joint_state(2, made.sync), heartbeat(2, 1.0), identity, Frame(heartbeat(2, 0.0).id, b"")):
        made.take(frame)
    assert [module.frames for module in made.modules] == [0, 4, 0]
    begin(made)
    assert made.modules[1].frames == 0


def test_strangers_are_counted_by_node() -> None:
    made = reading()
    for node in (4, 4, LAST_NODE, 0):
        made.take(Frame(frame_id(Opcode.HEARTBEAT, node), bytes(8)))
    assert made.strangers == {4: 2, LAST_NODE: 1, 0: 1} and not made.from_other_host


def test_another_host_is_noticed_and_is_no_stranger() -> None:
    made = reading()
    made.take(codec()[Opcode.SYNC].frame(0, count=3))
    made.take(codec()[Opcode.SET_POINT].frame(2))
    made.take(codec()[Opcode.SET_POINT].frame(40))
    made.take(Frame(frame_id(Opcode.EMERGENCY, 0), b""))
    for node in (0, 2, 40):
        made.take(command(Action.IDENTIFY, node))  # who merely asks who is there, commands nothing
    assert made.from_other_host == {Opcode.SYNC: 1, Opcode.SET_POINT: 2, Opcode.EMERGENCY: 1} and not made.strangers
    made.take(command(Action.STOP, 2))
    assert made.from_other_host[Opcode.COMMAND] == 1


# --- whatever comes ----------------------------------------------------------------------------------------

any_frame = st.builds(Frame, st.integers(0, 0x7FF), st.binary(max_size=8))
ours = st.builds(
    lambda opcode, node, data: Frame(frame_id(opcode, node), data[: codec()[opcode].length]),
    st.sampled_from(list(Opcode)),
    st.integers(1, JOINTS),
    st.binary(min_size=8, max_size=8),
)


@given(st.lists(any_frame | ours, max_size=40), st.lists(st.booleans(), min_size=40, max_size=40))
@example([Frame(frame_id(Opcode.JOINT_STATE, 2), b"")], [False] * 40)
def test_whatever_comes_nothing_raises_and_only_intact_states_move_a_joint(
    frames: list[Frame], sync_before: list[bool]
) -> None:
    made = reading()
    for frame, contacts in zip(frames, sync_before, strict=False):
        if contacts:
            begin(made, contacts=True, tail=True)
        before = made.joints()
        made.take(frame)
        is_state = opcode_of(frame.id) == Opcode.JOINT_STATE and len(frame.data) == 8 and intact(frame)
        changed = np.flatnonzero((made.joints() != before).any(axis=0)).tolist()
        assert changed in ([], [node_of(frame.id) - 1] if is_state else [])
        assert made.complete in (True, False)
        assert made.links_touched() is not None and made.imus() is not None and len(made.health()) == JOINTS


@given(st.integers(1, JOINTS), st.integers(0, 63))
def test_no_single_wrong_bit_moves_a_joint(node: int, bit: int) -> None:
    made = reading()
    begin(made)
    whole = int.from_bytes(joint_state(node, made.sync, 0.9).data, "little") ^ 1 << bit
    made.take(Frame(frame_id(Opcode.JOINT_STATE, node), whole.to_bytes(8, "little")))
    assert angles(made) == pytest.approx([0.1] * JOINTS) and made.modules[node - 1].corrupt == 1
