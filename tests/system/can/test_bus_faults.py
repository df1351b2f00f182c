"""What goes wrong with a bus, as the driver sees it on a kernel interface: what it says, and what the modules do.

Times are the modules' and the driver's periods of 10 ms, not this machine's: see `open_shared_bus`.
"""

import socket

import pytest

from snakesim_can_backend.driver.module_monitor import MIN_CONSECUTIVE_ERRORS
from snakesim_can_backend.protocol.definitions import ModuleState, Opcode, frame_id, parse_opcode
from snakesim_testing.can.driver_loop import reset_and_arm_again
from snakesim_testing.can.interface import assert_succeeded, pack_frame, run_ip, run_tc
from snakesim_testing.can.shared_bus import SharedBus, open_shared_bus

NODES = [1, 2, 3, 4]
PERIOD_MS, WATCHDOG_MS, LEASE_MS = 10, 100, 50
CAN_ERR_FLAG, CAN_EFF_FLAG, CAN_RTR_FLAG = 0x20000000, 0x80000000, 0x40000000
ACK, BUSOFF = 0x20, 0x40  # classes of linux/can/error.h


def moves_again(run: SharedBus) -> None:
    """Once a person has cleared the fault and armed."""
    reset_and_arm_again(run)
    assert max(run.true_speed_rad_s[-10:]) > 0.1


def set_points_out(run: SharedBus) -> int:
    return sum(parse_opcode(sent.id) == Opcode.SET_POINT for sent in run.wire.sent)


# --- the interface -----------------------------------------------------------------------------------------


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
        assert run.read_true_states() == [ModuleState.FAULT] * 4, "the modules' own watchdogs"
        stopped_ms = PERIOD_MS * next(
            n for n in range(1, 20) if run.true_states_by_tick[start + n] == {ModuleState.FAULT}
        )
        assert stopped_ms <= WATCHDOG_MS + PERIOD_MS
        run.run(40)
        assert run.is_at_rest()
        assert len(run.faults) == 1
        assert_succeeded(run_ip("link", "set", spare_channel, "up"))
        run.run(10)
        assert run.states() == [ModuleState.FAULT] * 4
        assert run.count_minor_errors("interface_up") == 1
        reported = {f.what for f in run.faults[1:]}
        assert reported and reported <= {"module_watchdog", "module_fault"}, "now they can tell"
        moves_again(run)


@pytest.mark.slow
def test_can_adapter_unplugged_and_plugged_in_again_is_used(spare_channel: str) -> None:
    with open_shared_bus(spare_channel) as run:
        assert_succeeded(run_ip("link", "delete", spare_channel))
        run.run(20, run.wave_joints)
        (fault,) = run.faults
        assert fault.what == "interface_down"
        assert_succeeded(run_ip("link", "add", spare_channel, "type", "vcan"))
        assert_succeeded(run_ip("link", "set", spare_channel, "up"))
        # The modules were never unplugged; only on this bus do they need this.
        run.wire.server.wires[0].errors()
        run.run(10)
        assert run.count_minor_errors("interface_up") == 1
        moves_again(run)


# --- a transmit queue that stays full ------------------------------------------------------------------------


@pytest.fixture
def slow_channel(spare_channel: str) -> str:
    """An interface that can be told to let next to nothing out: a traffic limit stands in for nobody acknowledging."""
    clog(spare_channel)
    unclog(spare_channel)
    return spare_channel


def clog(channel: str, frames: int = 2) -> None:
    queue = ("rate", "8bit", "burst", "16", "limit", str(16 * frames))
    limited = run_tc("qdisc", "add", "dev", channel, "root", "tbf", *queue)
    if limited.returncode:
        pytest.skip(f"no traffic limit here: {limited.stderr.strip()}")


def unclog(channel: str) -> None:
    assert_succeeded(run_tc("qdisc", "del", "dev", channel, "root"))


@pytest.mark.slow
def test_can_queue_full_for_three_periods_is_a_fault(slow_channel: str) -> None:
    with open_shared_bus(slow_channel) as run:
        clog(slow_channel)
        run.run(LEASE_MS // PERIOD_MS + 3, run.wave_joints)
        (fault,) = run.faults
        assert fault.what == "bus_stuck"
        assert "its transmit queue stays full" in fault.cause
        run.run(20)
        assert run.read_true_states() == [ModuleState.FAULT] * 4
        assert len(run.faults) == 1
        assert run.count_minor_errors("queue_full") > 0
        unclog(slow_channel)
        before = set_points_out(run)
        run.run(5)
        assert set_points_out(run) == before, "no setpoint of before goes out"
        moves_again(run)


@pytest.mark.slow
def test_can_queue_full_for_a_moment_is_counted_and_skipped(slow_channel: str) -> None:
    with open_shared_bus(slow_channel) as run:
        clog(slow_channel)
        run.run(MIN_CONSECUTIVE_ERRORS - 1, run.wave_joints)
        unclog(slow_channel)
        full, out = run.count_minor_errors("queue_full"), set_points_out(run)
        run.run(1, run.wave_joints)
        assert set_points_out(run) == out + 4, "one for each joint: the latest"
        run.run(30, run.wave_joints)
        assert not run.faults
        assert full > 0
        assert run.states() == [ModuleState.ARMED] * 4


@pytest.mark.slow
def test_can_long_queue_with_socket_share_full_counts_as_full(slow_channel: str) -> None:
    assert_succeeded(run_ip("link", "set", slow_channel, "txqueuelen", "1000"))
    with open_shared_bus(slow_channel) as run:
        # The kernel makes it its minimum.
        run.wire._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1)
        clog(slow_channel, frames=1000)
        run.run(LEASE_MS // PERIOD_MS + 3, run.wave_joints)
        assert "bus_stuck" in [fault.what for fault in run.faults]


# --- error frames --------------------------------------------------------------------------------------------


def error_frame(kind: int) -> bytes:
    return pack_frame(CAN_ERR_FLAG | kind, bytes([0, 0, 0, 0, 0, 0, 130, 7]))


def test_error_frames_of_the_controller_are_faults_or_counted(
    channel: str, raw_socket: socket.socket
) -> None:
    """All kinds are told apart in tests/system/can_bus/test_wire.py."""
    with open_shared_bus(channel) as run:
        raw_socket.send(error_frame(ACK))
        run.run(5, run.wave_joints)
        assert run.count_minor_errors("not_acknowledged") == 1
        assert not run.faults
        assert run.states() == [ModuleState.ARMED] * 4
        raw_socket.send(error_frame(BUSOFF))
        run.run(2, run.wave_joints)
        (fault,) = run.faults
        assert fault.what == "bus_off"
        assert fault.cause.startswith(f"{channel}: transmit errors 130, receive errors 7; ")
        out = set_points_out(run)
        run.run(30, run.wave_joints)
        assert run.lifecycle == "fault" and set_points_out(run) == out, "not one setpoint more"
        assert run.read_true_states() == [ModuleState.DISARMED] * 4
        assert run.is_at_rest()
        assert len(run.faults) == 1
        moves_again(run)


# --- a reader that is too slow -------------------------------------------------------------------------------


def test_frames_that_the_kernel_dropped_are_counted(
    channel: str, raw_socket: socket.socket
) -> None:
    with open_shared_bus(channel) as run:
        ours = run.wire._socket
        ours.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1)  # the kernel makes it its minimum
        for _ in range(50):
            raw_socket.send(pack_frame(frame_id(Opcode.HEALTH, 1)))
        ours.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 18)
        run.run(2, run.wave_joints)
        (fault,) = run.faults
        assert fault.what == "receive_overflow"
        dropped = int(fault.cause.partition("dropped ")[2].partition(" ")[0])
        kept = run.backend.modules.module_reports.malformed
        assert dropped > 0
        assert dropped + kept == 50
        moves_again(run)


# --- what others say -----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_an_emergency_from_the_bus_stops_and_is_latched(
    channel: str, raw_socket: socket.socket
) -> None:
    with open_shared_bus(channel) as run:
        raw_socket.send(pack_frame(frame_id(Opcode.EMERGENCY, 0), b"\x01"))
        run.run(1, run.wave_joints)
        assert run.read_true_states() == [ModuleState.EMERGENCY] * 4, "one frame"
        run.run(20)
        assert run.faults[0].what == "emergency"
        assert run.lifecycle == "fault"
        assert run.is_at_rest()
        assert run.read_true_states() == [ModuleState.EMERGENCY] * 4
        moves_again(run)


def test_extended_and_remote_frames_stay_in_the_kernel(
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
        # The modules' own are not zero.
        assert not [one for one in run.wire.receive() if one.data in (b"", bytes(8))]
        run.run(5, run.wave_joints)
        assert not run.faults
        assert run.states() == [ModuleState.ARMED] * 4
