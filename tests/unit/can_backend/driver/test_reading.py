"""Reports of joint modules: which states are accepted, and when a reading is complete."""

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
    for syncs_late, is_accepted in ((3, True), (4, False)):
        reports = make_module_reports(2)
        run_syncs(reports, syncs_late + 1, [1, 3])
        reports.process_frame(make_joint_state_frame(2, reports.sync - syncs_late, 0.9))
        assert (read_angles_rad(reports)[1] == pytest.approx(0.9)) is is_accepted
        assert reports.modules[1].sync == (reports.sync - 3 if is_accepted else 1)
        assert reports.modules[1].wrong_counter_count == (not is_accepted)
        assert (reports.states_missing == 1) is is_accepted, "it does not answer the newest Sync"


def test_reading_older_state_never_replaces_a_newer_one() -> None:
    reports = make_module_reports()
    start_sync(reports)
    reports.process_frame(make_joint_state_frame(2, reports.sync, 0.5))
    reports.process_frame(make_joint_state_frame(2, reports.sync - 1, -0.5))
    assert read_angles_rad(reports)[1] == pytest.approx(0.5)
    assert reports.modules[1].sync == reports.sync
    assert reports.modules[1].double_answers == 0, "a late answer is not a second answer"


def test_reading_two_answers_to_one_sync_count_once() -> None:
    reports = make_module_reports()
    module = reports.modules[1]
    for expected_count in (1, 2, 3):
        start_sync(reports)
        answer_sync(reports, [1, 2, 2, 2, 3])
        assert module.count_double_answers(reports.sync) == expected_count
    start_sync(reports)
    assert module.count_double_answers(reports.sync) == 3, "this Sync may still be answered twice"
    answer_sync(reports)
    start_sync(reports)
    assert module.count_double_answers(reports.sync) == 0
    answer_sync(reports, [1, 2, 2, 3])
    assert module.count_double_answers(reports.sync) == 1


def test_reading_unknown_state_counts_as_fault() -> None:
    reports = make_module_reports()
    start_sync(reports)
    write_state = load_layouts()[Opcode.JOINT_STATE].make_writer(
        "angle", "velocity", "torque", "count", "state", "derated"
    )
    reports.process_frame(write_state(2, (0, 0, 0, reports.sync, 7, 0)))
    assert reports.modules[1].state == ModuleState.FAULT
    write_heartbeat = load_layouts()[Opcode.HEARTBEAT].make_writer("state", "last_stop", "uptime")
    reports.process_frame(write_heartbeat(3, (15, 200, 1)))
    assert reports.modules[2].state == ModuleState.FAULT
    assert reports.modules[2].last_stop == LastStop.NONE


# --- complete readings -------------------------------------------------------------------------------------


def test_reading_is_complete_when_every_module_has_answered() -> None:
    reports = make_module_reports()
    start_sync(reports)
    for node in (1, 2):
        answer_sync(reports, [node])
        assert not reports.is_complete
    answer_sync(reports, [2])
    assert not reports.is_complete, "a second answer does not count for another module"
    answer_sync(reports, [3])
    assert reports.is_complete


def test_reading_waits_for_forces_only_at_requested_syncs() -> None:
    reports = make_module_reports()
    start_sync(reports, contacts=True, tail=True)
    answer_sync(reports)
    for node in (1, 2, 3):
        assert not reports.is_complete
        reports.process_frame(make_contact_frame(node, reports.sync))
    reports.process_frame(make_contact_frame(3, reports.sync))
    assert not reports.is_complete, "the contact of the tail link is missing"
    reports.process_frame(make_contact_frame(1, reports.sync, tail=True))
    assert reports.is_complete
    start_sync(reports, contacts=True)
    answer_sync(reports)
    for node in (1, 2, 3):
        reports.process_frame(make_contact_frame(node, reports.sync))
    assert reports.is_complete


def test_reading_does_not_wait_for_a_silent_module() -> None:
    reports = make_module_reports()
    run_syncs(reports, MAX_LATE_SYNCS, [1, 3])
    start_sync(reports, contacts=True, tail=True)
    answer_sync(reports, [1, 3])
    assert not reports.is_complete and reports.states_missing == 1, (
        "a module that missed three Syncs is still waited for"
    )
    start_sync(reports, contacts=True, tail=True)
    answer_sync(reports, [1, 3])
    for node in (1, 3):
        reports.process_frame(make_contact_frame(node, reports.sync))
    reports.process_frame(make_contact_frame(1, reports.sync, tail=True))
    assert reports.is_complete


def test_reading_without_tail_does_not_wait_for_its_link() -> None:
    reports = make_module_reports()
    run_syncs(reports, MAX_LATE_SYNCS + 1, [2, 3])
    start_sync(reports, contacts=True, tail=True)
    assert reports.states_missing == 2
    assert reports.contacts_missing == 2


def test_reading_waits_for_a_module_never_received() -> None:
    reports = ModuleReports(JOINT_COUNT)
    run_syncs(reports, 10, [1, 3])
    start_sync(reports)
    answer_sync(reports, [1, 3])
    assert not reports.is_complete


def test_reading_returned_module_does_not_replace_another() -> None:
    reports = make_module_reports()
    run_syncs(reports, 10, [1, 3])
    start_sync(reports, contacts=True)
    answer_sync(reports, [1, 2])
    reports.process_frame(make_contact_frame(1, reports.sync))
    reports.process_frame(make_contact_frame(2, reports.sync))
    assert reports.states_missing == 1
    assert reports.contacts_missing == 1
    answer_sync(reports, [3])
    reports.process_frame(make_contact_frame(3, reports.sync))
    assert reports.is_complete
    start_sync(reports)
    assert reports.states_missing == JOINT_COUNT
