"""Reports of joint modules: contact forces, IMUs, heartbeats, unknown nodes and arbitrary frames."""

import copy

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from snakesim_can_backend.protocol.codec import load_layouts
from snakesim_can_backend.protocol.definitions import (
    LAST_NODE,
    CanFrame,
    LastStop,
    ModuleState,
    Opcode,
    frame_id,
    has_valid_checksum,
    parse_node,
    parse_opcode,
)
from snakesim_testing.can.frames import (
    make_accelerometer_frame,
    make_contact_frame,
    make_gyro_frame,
    make_health_frame,
    make_heartbeat_frame,
    make_joint_state_frame,
    run_syncs,
    start_sync,
)
from snakesim_testing.can.module_reports import JOINT_COUNT, make_module_reports, read_angles_rad

# --- forces, IMUs, health ----------------------------------------------------------------------------------


def test_forces_of_another_sync_are_ignored_and_old_ones_dropped() -> None:
    reports = make_module_reports()
    start_sync(reports, contacts=True)
    reports.process_frame(make_contact_frame(2, reports.sync - 1, force_x=9.0))
    assert reports.list_contacts() == []
    assert reports.contacts_missing == JOINT_COUNT
    reports.process_frame(make_contact_frame(2, reports.sync, force_x=1.0))
    reports.process_frame(make_contact_frame(2, reports.sync, force_x=5.0))
    assert [raw[0] for _, raw in reports.list_contacts()] == [20], "the first report counts"
    assert reports.contacts_missing == JOINT_COUNT - 1
    start_sync(reports, contacts=False)
    assert len(reports.list_contacts()) == 1
    start_sync(reports, contacts=True)
    assert reports.list_contacts() == []


def test_imu_report_combines_frames_of_one_sync_only() -> None:
    reports = make_module_reports()
    reports.process_frame(make_gyro_frame(2, 7, 1.0))
    reports.process_frame(
        make_accelerometer_frame(2, 27, 9.81)
    )  # two frames between them were lost
    assert reports.pop_imu_reports() == []
    reports.process_frame(make_gyro_frame(2, 47, 2.0))
    reports.process_frame(make_accelerometer_frame(2, 47, 9.81))
    assert [list(rates) for _, rates, _ in reports.pop_imu_reports()] == [[2000, 0, 0]]


# --- heartbeats --------------------------------------------------------------------------------------------


MAX_UPTIME_S = 4294967.295  # upper end of the range of the signal, 49.7 days

UPTIMES = {  # uptime in s, and the number of restarts that are counted by then
    "restart that continues": [
        (5.0, 0),
        (5.1, 0),
        (5.1, 0),
        (0.1, 0),
        (0.2, 1),
        (0.3, 1),
    ],
    "two restarts": [(5.0, 0), (0.1, 0), (0.2, 1), (0.3, 1), (0.1, 1), (0.1, 2), (0.2, 2)],
    "two modules with one id": [
        (start_s + 0.1 * i, 0) for i in range(20) for start_s in (50.0, 0.0)
    ],
    "late heartbeat": [(5.0, 0), (5.2, 0), (5.1, 0), (5.3, 0), (5.4, 0)],
    "end of range": [(MAX_UPTIME_S - 0.05, 0), *[(MAX_UPTIME_S, 0)] * 4],
    "restart at end of range": [*[(MAX_UPTIME_S, 0)] * 2, (0.1, 0), (0.2, 1), (0.3, 1)],
    "counter that wraps": [
        (MAX_UPTIME_S - 0.05, 0),
        (0.05, 0),
        (0.15, 0),
        (0.25, 0),
    ],
}


@pytest.mark.parametrize("uptimes", UPTIMES.values(), ids=list(UPTIMES))
def test_uptime_that_restarts_and_continues_means_module_restart(
    uptimes: list[tuple[float, int]],
) -> None:
    reports = make_module_reports()
    for uptime_s, restarts in uptimes:
        reports.process_frame(make_heartbeat_frame(2, uptime_s))
        assert reports.modules[1].restarts == restarts, uptime_s
        assert reports.modules[1].uptime_ms == round(uptime_s * 1000)
    assert reports.modules[0].restarts == 0


def test_heartbeat_contains_state_faults_and_stop_reason() -> None:
    reports = make_module_reports()
    reports.process_frame(
        make_heartbeat_frame(
            2, 1.0, ModuleState.FAULT, last_stop=LastStop.LEAK, fault_leak=1, fault_voltage=1
        )
    )
    module = reports.modules[1]
    assert module.state == ModuleState.FAULT
    assert module.last_stop == LastStop.LEAK
    assert module.list_fault_names() == ["leak", "voltage"]
    assert module.is_clear_required
    assert module.heartbeat_sync == reports.sync
    reports.process_frame(make_heartbeat_frame(2, 1.1))
    assert module.list_fault_names() == []
    assert not module.is_clear_required


@pytest.mark.parametrize("state", [ModuleState.FAULT, ModuleState.EMERGENCY])
def test_latched_state_without_reason_needs_clearing_after_three_syncs(state: ModuleState) -> None:
    reports = make_module_reports()
    for is_required in (False, False, True):
        run_syncs(reports, 1, state=state)
        assert reports.modules[0].is_clear_required is is_required
    run_syncs(reports, 1, state=ModuleState.DISARMED)
    assert not reports.modules[0].is_clear_required


# --- malformed frames and unknown nodes --------------------------------------------------------------------


def test_frames_of_another_length_are_counted_and_change_nothing() -> None:
    reports = make_module_reports()
    before = copy.deepcopy(reports.modules)
    valid_frames = [
        make_joint_state_frame(2, reports.sync),
        make_heartbeat_frame(2, 0.0),
        make_contact_frame(2, 0),
        make_gyro_frame(2, 0, 0.0),
        make_health_frame(2),
    ]
    for i, frame in enumerate(valid_frames):
        reports.process_frame(CanFrame(frame.id, frame.data[:-1]))
        reports.process_frame(CanFrame(frame.id, b""))
        assert reports.malformed == 2 * (i + 1)
    before[1].frame_count = reports.modules[1].frame_count
    assert reports.modules == before
    assert reports.list_health_reports() == [None] * JOINT_COUNT


def test_frames_of_unknown_nodes_are_counted_by_node() -> None:
    reports = make_module_reports()
    for node in (4, 4, LAST_NODE, 0):
        reports.process_frame(CanFrame(frame_id(Opcode.HEARTBEAT, node), bytes(8)))
    assert reports.unknown_node_frame_counts == {4: 2, LAST_NODE: 1, 0: 1}
    assert not reports.other_host_frame_counts


# --- arbitrary frames --------------------------------------------------------------------------------------

any_frames = st.builds(CanFrame, st.integers(0, 0x7FF), st.binary(max_size=8))
valid_frames_of_modules = st.builds(
    lambda opcode, node, data: CanFrame(
        frame_id(opcode, node), data[: load_layouts()[opcode].length]
    ),
    st.sampled_from(list(Opcode)),
    st.integers(1, JOINT_COUNT),
    st.binary(min_size=8, max_size=8),
)


@given(
    st.lists(any_frames | valid_frames_of_modules, max_size=40),
    st.lists(st.booleans(), min_size=40, max_size=40),
)
@example([CanFrame(frame_id(Opcode.JOINT_STATE, 2), b"")], [False] * 40)
def test_reader_of_arbitrary_frames_never_raises_or_moves_a_joint(
    frames: list[CanFrame], sync_before: list[bool]
) -> None:
    reports = make_module_reports()
    for frame, begins_sync in zip(frames, sync_before, strict=False):
        if begins_sync:
            start_sync(reports, contacts=True, tail=True)
        before = reports.shaft_values()
        reports.process_frame(frame)
        is_state = (
            parse_opcode(frame.id) == Opcode.JOINT_STATE
            and len(frame.data) == 8
            and has_valid_checksum(frame)
        )
        changed_joints = np.flatnonzero((reports.shaft_values() != before).any(axis=0)).tolist()
        assert changed_joints in ([], [parse_node(frame.id) - 1] if is_state else [])
        assert reports.is_complete in (True, False)
        assert reports.list_contacts() is not None
        assert reports.pop_imu_reports() is not None
        assert len(reports.list_health_reports()) == JOINT_COUNT


@given(st.integers(1, JOINT_COUNT), st.integers(0, 63))
def test_state_with_one_wrong_bit_moves_no_joint(node: int, bit: int) -> None:
    reports = make_module_reports()
    start_sync(reports)
    flipped_data = (
        int.from_bytes(make_joint_state_frame(node, reports.sync, 0.9).data, "little") ^ 1 << bit
    )
    reports.process_frame(
        CanFrame(frame_id(Opcode.JOINT_STATE, node), flipped_data.to_bytes(8, "little"))
    )
    assert read_angles_rad(reports) == pytest.approx([0.1] * JOINT_COUNT)
    assert reports.modules[node - 1].corrupt_state_count == 1
