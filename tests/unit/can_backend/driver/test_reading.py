"""What is taken of the modules' frames, and what is noticed of those that are not as they should be."""

import pytest

from snakesim_can_backend.driver.reports import MAX_LATE_SYNCS, ModuleReports
from snakesim_can_backend.protocol.codec import load_layouts
from snakesim_can_backend.protocol.definitions import LastStop, ModuleState, Opcode
from snakesim_testing.can.frames import (
    answer_sync,
    make_contact_frame,
    make_joint_state_frame,
    run_syncs,
    start_sync,
)
from snakesim_testing.can.module_reports import JOINT_COUNT, make_module_reports, read_angles_rad

# --- states ------------------------------------------------------------------------------------------------


def test_reading_states_up_to_three_syncs_late_are_accepted() -> None:
    for late, taken in ((3, True), (4, False)):
        made = make_module_reports(2)
        run_syncs(made, late + 1, [1, 3])
        made.process_frame(make_joint_state_frame(2, made.sync - late, 0.9))
        assert (read_angles_rad(made)[1] == pytest.approx(0.9)) is taken
        assert made.modules[1].sync == (made.sync - 3 if taken else 1)
        assert made.modules[1].wrong_counter_count == (not taken)
        assert (made.states_missing == 1) is taken, "the newest Sync is not answered by it"


def test_an_older_state_never_replaces_a_newer_one() -> None:
    made = make_module_reports()
    start_sync(made)
    made.process_frame(make_joint_state_frame(2, made.sync, 0.5))
    made.process_frame(make_joint_state_frame(2, made.sync - 1, -0.5))
    assert read_angles_rad(made)[1] == pytest.approx(0.5)
    assert made.modules[1].sync == made.sync
    assert made.modules[1].double_answers == 0, "late is not twice"


def test_reading_two_answers_to_one_sync_count_once() -> None:
    made = make_module_reports()
    module = made.modules[1]
    for expected in (1, 2, 3):
        start_sync(made)
        answer_sync(made, [1, 2, 2, 2, 3])
        assert module.count_double_answers(made.sync) == expected
    start_sync(made)
    assert module.count_double_answers(made.sync) == 3, "this Sync may still be answered twice"
    answer_sync(made)
    start_sync(made)
    assert module.count_double_answers(made.sync) == 0
    answer_sync(made, [1, 2, 2, 3])
    assert module.count_double_answers(made.sync) == 1


def test_an_unknown_state_is_a_fault() -> None:
    made = make_module_reports()
    start_sync(made)
    write = load_layouts()[Opcode.JOINT_STATE].make_writer(
        "angle", "velocity", "torque", "count", "state", "derated"
    )
    made.process_frame(write(2, (0, 0, 0, made.sync, 7, 0)))
    assert made.modules[1].state == ModuleState.FAULT
    beat = load_layouts()[Opcode.HEARTBEAT].make_writer("state", "last_stop", "uptime")
    made.process_frame(beat(3, (15, 200, 1)))
    assert made.modules[2].state == ModuleState.FAULT
    assert made.modules[2].last_stop == LastStop.NONE


# --- who is waited for -------------------------------------------------------------------------------------


def test_reading_is_complete_when_every_module_has_answered() -> None:
    made = make_module_reports()
    start_sync(made)
    for node in (1, 2):
        answer_sync(made, [node])
        assert not made.is_complete
    answer_sync(made, [2])
    assert not made.is_complete, "an answer that comes twice is not somebody else's"
    answer_sync(made, [3])
    assert made.is_complete


def test_reading_waits_for_forces_only_at_requested_syncs() -> None:
    made = make_module_reports()
    start_sync(made, contacts=True, tail=True)
    answer_sync(made)
    for node in (1, 2, 3):
        assert not made.is_complete
        made.process_frame(make_contact_frame(node, made.sync))
    made.process_frame(make_contact_frame(3, made.sync))
    assert not made.is_complete, "the tail's own is missing"
    made.process_frame(make_contact_frame(1, made.sync, tail=True))
    assert made.is_complete
    start_sync(made, contacts=True)
    answer_sync(made)
    for node in (1, 2, 3):
        made.process_frame(make_contact_frame(node, made.sync))
    assert made.is_complete


def test_reading_does_not_wait_for_a_silent_module() -> None:
    made = make_module_reports()
    run_syncs(made, MAX_LATE_SYNCS, [1, 3])
    start_sync(made, contacts=True, tail=True)
    answer_sync(made, [1, 3])
    assert not made.is_complete and made.states_missing == 1, "three Syncs are not long"
    start_sync(made, contacts=True, tail=True)
    answer_sync(made, [1, 3])
    for node in (1, 3):
        made.process_frame(make_contact_frame(node, made.sync))
    made.process_frame(make_contact_frame(1, made.sync, tail=True))
    assert made.is_complete


def test_reading_without_tail_does_not_wait_for_its_link() -> None:
    made = make_module_reports()
    run_syncs(made, MAX_LATE_SYNCS + 1, [2, 3])
    start_sync(made, contacts=True, tail=True)
    assert made.states_missing == 2
    assert made.contacts_missing == 2


def test_reading_waits_for_a_module_never_received() -> None:
    made = ModuleReports(JOINT_COUNT)
    run_syncs(made, 10, [1, 3])
    start_sync(made)
    answer_sync(made, [1, 3])
    assert not made.is_complete


def test_reading_returned_module_does_not_replace_another() -> None:
    made = make_module_reports()
    run_syncs(made, 10, [1, 3])
    start_sync(made, contacts=True)
    answer_sync(made, [1, 2])
    made.process_frame(make_contact_frame(1, made.sync))
    made.process_frame(make_contact_frame(2, made.sync))
    assert made.states_missing == 1
    assert made.contacts_missing == 1
    answer_sync(made, [3])
    made.process_frame(make_contact_frame(3, made.sync))
    assert made.is_complete
    start_sync(made)
    assert made.states_missing == JOINT_COUNT
