"""What the reading keeps of forces, IMUs, heartbeats, strangers and noise."""

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
    made = make_module_reports()
    start_sync(made, contacts=True)
    made.process_frame(make_contact_frame(2, made.sync - 1, force_x=9.0))
    assert made.list_contacts() == []
    assert made.contacts_missing == JOINT_COUNT
    made.process_frame(make_contact_frame(2, made.sync, force_x=1.0))
    made.process_frame(make_contact_frame(2, made.sync, force_x=5.0))
    assert [raw[0] for _, raw in made.list_contacts()] == [20], "the first counts"
    assert made.contacts_missing == JOINT_COUNT - 1
    start_sync(made, contacts=False)
    assert len(made.list_contacts()) == 1
    start_sync(made, contacts=True)
    assert made.list_contacts() == []


def test_an_imus_halves_are_of_one_sync() -> None:
    made = make_module_reports()
    made.process_frame(make_gyro_frame(2, 7, 1.0))
    made.process_frame(make_accelerometer_frame(2, 27, 9.81))  # between them two frames were lost
    assert made.pop_imu_reports() == []
    made.process_frame(make_gyro_frame(2, 47, 2.0))
    made.process_frame(make_accelerometer_frame(2, 47, 9.81))
    assert [list(rates) for _, rates, _ in made.pop_imu_reports()] == [[2000, 0, 0]]


# --- heartbeats --------------------------------------------------------------------------------------------


MAX_UPTIME_S = 4294967.295  # the end of the signal's range

UPTIMES = {  # s, and how many restarts they are by then
    "back, and on from there: a restart": [
        (5.0, 0),
        (5.1, 0),
        (5.1, 0),
        (0.1, 0),
        (0.2, 1),
        (0.3, 1),
    ],
    "and the next restart": [(5.0, 0), (0.1, 0), (0.2, 1), (0.3, 1), (0.1, 1), (0.1, 2), (0.2, 2)],
    "two clocks in turn: two modules": [
        (start_s + 0.1 * i, 0) for i in range(20) for start_s in (50.0, 0.0)
    ],
    "one that comes late": [(5.0, 0), (5.2, 0), (5.1, 0), (5.3, 0), (5.4, 0)],
    "49.7 days, at the end of the range": [(MAX_UPTIME_S - 0.05, 0), *[(MAX_UPTIME_S, 0)] * 4],
    "49.7 days, and a restart": [*[(MAX_UPTIME_S, 0)] * 2, (0.1, 0), (0.2, 1), (0.3, 1)],
    "49.7 days, in firmware that wraps": [
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
    made = make_module_reports()
    for uptime_s, restarts in uptimes:
        made.process_frame(make_heartbeat_frame(2, uptime_s))
        assert made.modules[1].restarts == restarts, uptime_s
        assert made.modules[1].uptime_ms == round(uptime_s * 1000)
    assert made.modules[0].restarts == 0


def test_a_heartbeat_tells_state_faults_and_reason() -> None:
    made = make_module_reports()
    made.process_frame(
        make_heartbeat_frame(
            2, 1.0, ModuleState.FAULT, last_stop=LastStop.LEAK, fault_leak=1, fault_voltage=1
        )
    )
    module = made.modules[1]
    assert module.state == ModuleState.FAULT
    assert module.last_stop == LastStop.LEAK
    assert module.list_fault_names() == ["leak", "voltage"]
    assert module.is_clear_required
    assert module.heartbeat_sync == made.sync
    made.process_frame(make_heartbeat_frame(2, 1.1))
    assert module.list_fault_names() == []
    assert not module.is_clear_required


@pytest.mark.parametrize("state", [ModuleState.FAULT, ModuleState.EMERGENCY])
def test_latched_state_without_reason_needs_clearing_after_three_syncs(state: ModuleState) -> None:
    made = make_module_reports()
    for needed in (False, False, True):
        run_syncs(made, 1, state=state)
        assert made.modules[0].is_clear_required is needed
    run_syncs(made, 1, state=ModuleState.DISARMED)
    assert not made.modules[0].is_clear_required


# --- others ------------------------------------------------------------------------------------------------


def test_frames_of_another_length_are_counted_and_change_nothing() -> None:
    made = make_module_reports()
    before = copy.deepcopy(made.modules)
    good = [
        make_joint_state_frame(2, made.sync),
        make_heartbeat_frame(2, 0.0),
        make_contact_frame(2, 0),
        make_gyro_frame(2, 0, 0.0),
        make_health_frame(2),
    ]
    for i, frame in enumerate(good):
        made.process_frame(CanFrame(frame.id, frame.data[:-1]))
        made.process_frame(CanFrame(frame.id, b""))
        assert made.malformed == 2 * (i + 1)
    before[1].frame_count = made.modules[1].frame_count
    assert made.modules == before
    assert made.list_health_reports() == [None] * JOINT_COUNT


def test_strangers_are_counted_by_node() -> None:
    made = make_module_reports()
    for node in (4, 4, LAST_NODE, 0):
        made.process_frame(CanFrame(frame_id(Opcode.HEARTBEAT, node), bytes(8)))
    assert made.unknown_node_frame_counts == {4: 2, LAST_NODE: 1, 0: 1}
    assert not made.other_host_frame_counts


# --- whatever comes ----------------------------------------------------------------------------------------

any_frame = st.builds(CanFrame, st.integers(0, 0x7FF), st.binary(max_size=8))
ours = st.builds(
    lambda opcode, node, data: CanFrame(
        frame_id(opcode, node), data[: load_layouts()[opcode].length]
    ),
    st.sampled_from(list(Opcode)),
    st.integers(1, JOINT_COUNT),
    st.binary(min_size=8, max_size=8),
)


@given(st.lists(any_frame | ours, max_size=40), st.lists(st.booleans(), min_size=40, max_size=40))
@example([CanFrame(frame_id(Opcode.JOINT_STATE, 2), b"")], [False] * 40)
def test_reader_of_arbitrary_frames_never_raises_or_moves_a_joint(
    frames: list[CanFrame], sync_before: list[bool]
) -> None:
    made = make_module_reports()
    for frame, contacts in zip(frames, sync_before, strict=False):
        if contacts:
            start_sync(made, contacts=True, tail=True)
        before = made.shaft_values()
        made.process_frame(frame)
        is_state = (
            parse_opcode(frame.id) == Opcode.JOINT_STATE
            and len(frame.data) == 8
            and has_valid_checksum(frame)
        )
        changed = np.flatnonzero((made.shaft_values() != before).any(axis=0)).tolist()
        assert changed in ([], [parse_node(frame.id) - 1] if is_state else [])
        assert made.is_complete in (True, False)
        assert made.list_contacts() is not None
        assert made.pop_imu_reports() is not None
        assert len(made.list_health_reports()) == JOINT_COUNT


@given(st.integers(1, JOINT_COUNT), st.integers(0, 63))
def test_no_single_wrong_bit_moves_a_joint(node: int, bit: int) -> None:
    made = make_module_reports()
    start_sync(made)
    whole = int.from_bytes(make_joint_state_frame(node, made.sync, 0.9).data, "little") ^ 1 << bit
    made.process_frame(CanFrame(frame_id(Opcode.JOINT_STATE, node), whole.to_bytes(8, "little")))
    assert read_angles_rad(made) == pytest.approx([0.1] * JOINT_COUNT)
    assert made.modules[node - 1].corrupt_state_count == 1
