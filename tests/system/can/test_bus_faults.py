"""Faults of a bus on a kernel interface are reported by the driver, and the modules stop.

Times are counted in periods of 10 ms of the modules and the driver, not by the clock of this machine: see
`open_shared_bus`.
"""

import socket

import pytest

from snakesim_can_backend.driver.module_monitor import MIN_CONSECUTIVE_ERRORS
from snakesim_can_backend.protocol.definitions import ModuleState, Opcode, frame_id, parse_opcode
from snakesim_testing.can.driver_loop import reset_and_arm_again
from snakesim_testing.can.interface import assert_succeeded, pack_frame, run_ip, run_tc
from snakesim_testing.can.shared_bus import SharedBus, open_shared_bus

NODES = [1, 2, 3, 4]
PERIOD_MS = 10
WATCHDOG_MS = 100
LEASE_MS = 50
CAN_ERR_FLAG = 0x20000000
CAN_EFF_FLAG = 0x80000000
CAN_RTR_FLAG = 0x40000000
ACK = 0x20  # a class of linux/can/error.h
BUSOFF = 0x40  # another one


def assert_moves_after_reset(run: SharedBus) -> None:
    """Reset the fault, arm the robot, and check that it moves."""
    reset_and_arm_again(run)
    assert max(run.true_speed_rad_s[-10:]) > 0.1


def count_sent_setpoints(run: SharedBus) -> int:
    """Return how many setpoints the driver has sent."""
    return sum(parse_opcode(sent.id) == Opcode.SET_POINT for sent in run.wire.sent)


# --- the interface -----------------------------------------------------------------------------------------------


def test_can_interface_down_stops_joints_and_recovers(spare_channel: str) -> None:
    with open_shared_bus(spare_channel) as run:
        assert_succeeded(run_ip("link", "set", spare_channel, "down"))
        start = run.tick
        run.run(WATCHDOG_MS // PERIOD_MS + 3, run.wave_joints)
        (fault,) = run.faults
        assert fault.what == "interface_down"
        assert fault.cause.startswith(f"{spare_channel}: the interface is down")
        assert run.lifecycle == "fault"
        assert fault.tick - start <= 1
        # The watchdogs of the modules have expired.
        assert run.read_true_states() == [ModuleState.FAULT] * 4
        stop_ticks = next(
            ticks
            for ticks in range(1, 20)
            if run.true_states_by_tick[start + ticks] == {ModuleState.FAULT}
        )
        assert stop_ticks * PERIOD_MS <= WATCHDOG_MS + PERIOD_MS
        run.run(40)
        assert run.is_at_rest()
        assert len(run.faults) == 1
        assert_succeeded(run_ip("link", "set", spare_channel, "up"))
        run.run(10)
        assert run.states() == [ModuleState.FAULT] * 4
        assert run.count_minor_errors("interface_up") == 1
        # Now the modules can report their faults.
        module_faults = {fault.what for fault in run.faults[1:]}
        assert module_faults
        assert module_faults <= {"module_watchdog", "module_fault"}
        assert_moves_after_reset(run)


@pytest.mark.slow
def test_can_adapter_unplugged_and_plugged_in_again_is_used(spare_channel: str) -> None:
    with open_shared_bus(spare_channel) as run:
        assert_succeeded(run_ip("link", "delete", spare_channel))
        run.run(20, run.wave_joints)
        (fault,) = run.faults
        assert fault.what == "interface_down"
        assert_succeeded(run_ip("link", "add", spare_channel, "type", "vcan"))
        assert_succeeded(run_ip("link", "set", spare_channel, "up"))
        # The emulated modules share the interface, so that their wire must open it again, too.
        run.wire.server.wires[0].errors()
        run.run(10)
        assert run.count_minor_errors("interface_up") == 1
        assert_moves_after_reset(run)


# --- a transmit queue that stays full ----------------------------------------------------------------------------


@pytest.fixture
def slow_channel(spare_channel: str) -> str:
    """Provide an interface whose traffic can be limited, as on a bus without a node that acknowledges frames."""
    limit_traffic(spare_channel)
    remove_traffic_limit(spare_channel)
    return spare_channel


def limit_traffic(channel: str, frames: int = 2) -> None:
    """Let almost no frame out; the queue has space for this number of frames."""
    queue = ("rate", "8bit", "burst", "16", "limit", str(16 * frames))
    limited = run_tc("qdisc", "add", "dev", channel, "root", "tbf", *queue)
    if limited.returncode:
        pytest.skip(f"no traffic limit here: {limited.stderr.strip()}")


def remove_traffic_limit(channel: str) -> None:
    """Let the queued frames out."""
    assert_succeeded(run_tc("qdisc", "del", "dev", channel, "root"))


@pytest.mark.slow
def test_can_queue_full_for_three_periods_is_a_fault(slow_channel: str) -> None:
    with open_shared_bus(slow_channel) as run:
        limit_traffic(slow_channel)
        run.run(LEASE_MS // PERIOD_MS + 3, run.wave_joints)
        (fault,) = run.faults
        assert fault.what == "bus_stuck"
        assert "its transmit queue stays full" in fault.cause
        run.run(20)
        assert run.read_true_states() == [ModuleState.FAULT] * 4
        assert len(run.faults) == 1
        assert run.count_minor_errors("queue_full") > 0
        remove_traffic_limit(slow_channel)
        sent_before = count_sent_setpoints(run)
        run.run(5)
        assert count_sent_setpoints(run) == sent_before, "the driver sent an old setpoint"
        assert_moves_after_reset(run)


@pytest.mark.slow
def test_can_queue_full_for_a_moment_is_counted_and_skipped(slow_channel: str) -> None:
    with open_shared_bus(slow_channel) as run:
        limit_traffic(slow_channel)
        run.run(MIN_CONSECUTIVE_ERRORS - 1, run.wave_joints)
        remove_traffic_limit(slow_channel)
        full_count = run.count_minor_errors("queue_full")
        sent_before = count_sent_setpoints(run)
        run.run(1, run.wave_joints)
        assert count_sent_setpoints(run) == sent_before + 4, "not one setpoint for each joint"
        run.run(30, run.wave_joints)
        assert not run.faults
        assert full_count > 0
        assert run.states() == [ModuleState.ARMED] * 4


@pytest.mark.slow
def test_can_long_queue_with_socket_share_full_counts_as_full(slow_channel: str) -> None:
    assert_succeeded(run_ip("link", "set", slow_channel, "txqueuelen", "1000"))
    with open_shared_bus(slow_channel) as run:
        # The kernel increases this size to its minimum.
        run.wire._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1)
        limit_traffic(slow_channel, frames=1000)
        run.run(LEASE_MS // PERIOD_MS + 3, run.wave_joints)
        assert "bus_stuck" in [fault.what for fault in run.faults]


# --- error frames ------------------------------------------------------------------------------------------------


def make_error_frame(kind: int) -> bytes:
    return pack_frame(CAN_ERR_FLAG | kind, bytes([0, 0, 0, 0, 0, 0, 130, 7]))


def test_can_error_frames_are_reported_as_faults_or_counted(
    channel: str, raw_socket: socket.socket
) -> None:
    """All kinds of error frames are decoded in tests/system/can_bus/test_wire.py."""
    with open_shared_bus(channel) as run:
        raw_socket.send(make_error_frame(ACK))
        run.run(5, run.wave_joints)
        assert run.count_minor_errors("not_acknowledged") == 1
        assert not run.faults
        assert run.states() == [ModuleState.ARMED] * 4
        raw_socket.send(make_error_frame(BUSOFF))
        run.run(2, run.wave_joints)
        (fault,) = run.faults
        assert fault.what == "bus_off"
        assert fault.cause.startswith(f"{channel}: transmit errors 130, receive errors 7; ")
        sent_before = count_sent_setpoints(run)
        run.run(30, run.wave_joints)
        assert run.lifecycle == "fault"
        assert count_sent_setpoints(run) == sent_before, (
            "the driver sent a setpoint after the fault"
        )
        assert run.read_true_states() == [ModuleState.DISARMED] * 4
        assert run.is_at_rest()
        assert len(run.faults) == 1
        assert_moves_after_reset(run)


# --- a reader that is too slow -----------------------------------------------------------------------------------


def test_can_frames_dropped_by_kernel_are_counted(channel: str, raw_socket: socket.socket) -> None:
    with open_shared_bus(channel) as run:
        driver_socket = run.wire._socket
        # The kernel increases this size to its minimum.
        driver_socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1)
        for _ in range(50):
            raw_socket.send(pack_frame(frame_id(Opcode.HEALTH, 1)))
        driver_socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 18)
        run.run(2, run.wave_joints)
        (fault,) = run.faults
        assert fault.what == "receive_overflow"
        dropped_count = int(fault.cause.partition("dropped ")[2].partition(" ")[0])
        received_count = run.backend.modules.module_reports.malformed
        assert dropped_count > 0
        assert dropped_count + received_count == 50
        assert_moves_after_reset(run)


# --- frames of other nodes ---------------------------------------------------------------------------------------


@pytest.mark.slow
def test_can_emergency_frame_of_other_node_stops_and_is_latched(
    channel: str, raw_socket: socket.socket
) -> None:
    with open_shared_bus(channel) as run:
        raw_socket.send(pack_frame(frame_id(Opcode.EMERGENCY, 0), b"\x01"))
        run.run(1, run.wave_joints)
        assert run.read_true_states() == [ModuleState.EMERGENCY] * 4
        run.run(20)
        assert run.faults[0].what == "emergency"
        assert run.lifecycle == "fault"
        assert run.is_at_rest()
        assert run.read_true_states() == [ModuleState.EMERGENCY] * 4
        assert_moves_after_reset(run)


def test_can_extended_and_remote_frames_are_filtered_by_kernel(
    channel: str, raw_socket: socket.socket
) -> None:
    with open_shared_bus(channel) as run:
        for number in (
            frame_id(Opcode.HEARTBEAT, 40),
            frame_id(Opcode.SYNC, 0),
            frame_id(Opcode.JOINT_STATE, 1),
        ):
            for _ in range(5):
                raw_socket.send(pack_frame(CAN_EFF_FLAG | number, bytes(8)))
                raw_socket.send(pack_frame(CAN_EFF_FLAG | 0x12340000 | number, bytes(8)))
                raw_socket.send(pack_frame(CAN_RTR_FLAG | number))
        # The frames of the modules are not zero.
        assert not [frame for frame in run.wire.receive() if frame.data in (b"", bytes(8))]
        run.run(5, run.wave_joints)
        assert not run.faults
        assert run.states() == [ModuleState.ARMED] * 4
