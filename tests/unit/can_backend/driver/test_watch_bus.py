"""The module monitor reports faults of buses, unknown nodes and other programs that command the modules."""

import pytest

from snakesim_can_backend.bus.bus_errors import BusError, Kind
from snakesim_can_backend.driver.module_monitor import FaultFinding
from snakesim_can_backend.driver.reports import ModuleReports
from snakesim_can_backend.protocol.codec import load_layouts
from snakesim_can_backend.protocol.commands import make_command
from snakesim_can_backend.protocol.definitions import (
    CanFrame,
    CommandAction,
    ModuleState,
    Opcode,
    frame_id,
)
from snakesim_testing.can.frames import answer_sync, make_joint_state_frame
from snakesim_testing.can.monitor_rig import MonitorRig, list_findings, make_reply, send_nothing

# --- the bus -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "advice"),
    [
        ("bus_off", "look for a short, a wrong bit rate, a missing terminator"),
        ("error_passive", "look at cables, terminators and bit rate"),
        ("interface_down", "bring it up again, then reset and arm"),
        ("restarted", "reset and arm when the bus is in order"),
        ("receive_overflow", "states may be missing"),
    ],
)
def test_bus_watch_bus_failure_is_reported_without_joint(kind: Kind, advice: str) -> None:
    rig = MonitorRig()
    error = BusError(kind, "can0", "transmit errors 200, receive errors 3")
    (finding,) = rig.run_tick(errors=[error])
    assert finding.what == kind
    assert finding.joint is None
    assert finding.cause.startswith("can0: transmit errors 200, receive errors 3; ")
    assert advice in finding.cause
    assert rig.run_tick(errors=[error]) == []
    assert [
        reported.cause[:5] for reported in rig.run_tick(errors=[BusError(kind, "can1", "")])
    ] == ["can1:"], "the same fault of another bus is a new fault"
    rig.reset()
    assert list_findings(rig.run_tick(errors=[error])) == [(kind, None)]


@pytest.mark.parametrize(
    "kind", ["error_warning", "not_acknowledged", "queue_full", "error_frames", "interface_up"]
)
def test_bus_watch_minor_errors_are_only_counted(kind: Kind) -> None:
    rig = MonitorRig()
    for _ in range(2):
        assert rig.run_tick(errors=[BusError(kind, "can0", "")]) == []
    assert rig.monitor.minor_error_counts == {kind: 2}


def test_bus_watch_bus_full_for_three_periods_is_stuck() -> None:
    rig = MonitorRig()
    for full_channel in ("can1", "can1", "", "can1", "can1"):
        assert rig.run_tick(unsent=full_channel) == [], "a queue may be full for a moment"
    (finding,) = rig.run_tick(unsent="can1")
    assert finding.what == "bus_stuck"
    assert finding.joint is None
    for text in (
        "can1: ",
        "no frames sent for 30 ms",
        "no node acknowledges",
        "txqueuelen is below 64",
    ):
        assert text in finding.cause
    assert rig.run_tick(unsent="can1") == []


# --- unknown nodes and other hosts -------------------------------------------------------------------------


def answer_with_unknown_node(reading: ModuleReports) -> None:
    """Let node 9 answer_sync, too, which is no joint of the robot."""
    answer_sync(reading, [2])
    reading.process_frame(make_joint_state_frame(9, reading.sync))


def test_bus_watch_unknown_node_answering_every_sync_is_reported() -> None:
    rig = MonitorRig()
    assert rig.run_ticks(2, answer_with_unknown_node) == []
    (finding,) = rig.run_tick(answer_with_unknown_node)
    assert finding == FaultFinding(
        "unknown_node", "node 9 is on the bus, but is not a joint of this robot"
    )
    assert rig.run_ticks(5, answer_with_unknown_node) == []


@pytest.mark.parametrize(
    ("frame", "expected_fault", "expected_text"),
    [
        (
            load_layouts()[Opcode.SYNC].encode(0),
            "second_host",
            "another program commands the modules",
        ),
        (load_layouts()[Opcode.SET_POINT].encode(2), "second_host", "end one of the two"),
        (load_layouts()[Opcode.SET_POINT].encode(40), "second_host", "end one of the two"),
        (
            load_layouts()[Opcode.COMMAND].encode(2, action=CommandAction.STOP),
            "second_host",
            "another program",
        ),
        (
            CanFrame(frame_id(Opcode.EMERGENCY, 0), b"\x01"),
            "emergency",
            "a node on the bus sent an Emergency",
        ),
    ],
)
def test_bus_watch_reports_a_second_host(
    frame: CanFrame, expected_fault: str, expected_text: str
) -> None:
    rig = MonitorRig()
    send_frame = make_reply(ModuleState.DISARMED, frame)
    (finding,) = rig.run_tick(send_frame)
    assert finding.what == expected_fault
    assert finding.joint is None
    assert expected_text in finding.cause
    assert rig.run_tick(send_frame) == []
    rig.reset()
    assert rig.run_tick() == [], "the second host has ended"
    assert list_findings(rig.run_tick(send_frame)) == [(expected_fault, None)]


def test_bus_watch_parameters_changed_by_another_host_are_rewritten() -> None:
    rig = MonitorRig()
    rig.reports.process_frame(
        load_layouts()[Opcode.PARAMETER_REQUEST].encode(2, index=1, operation=1)
    )
    assert list_findings(rig.run_tick()) == [("second_host", None)]
    assert rig.monitor.pop_changed_joints() == {0, 1, 2}


def test_bus_watch_identity_request_is_no_second_host() -> None:
    rig = MonitorRig()
    rig.reports.process_frame(make_command(CommandAction.IDENTIFY))
    assert rig.run_tick() == []
    assert rig.monitor.pop_changed_joints() == set()


def test_bus_watch_module_without_sync_is_not_silent() -> None:
    rig = MonitorRig()
    for i in range(10):
        assert list_findings(rig.run_tick(send_nothing, unsent="can0")) == (
            [("bus_stuck", None)] if i == 2 else []
        )
    assert rig.run_ticks(2, send_nothing) == []
    assert list_findings(rig.run_tick(send_nothing)) == [("module_silent", 1)]


def test_bus_watch_interface_down_is_not_also_reported_stuck() -> None:
    rig = MonitorRig()
    down = BusError("interface_down", "can1", "")
    up = BusError("interface_up", "can1", "")
    assert list_findings(rig.run_tick(errors=[down], unsent="can1")) == [("interface_down", None)]
    for _ in range(10):
        assert rig.run_tick(unsent="can1") == []
    rig.run_tick(errors=[up], unsent="can1")
    findings = [finding for _ in range(3) for finding in rig.run_tick(unsent="can1")]
    assert list_findings(findings) == [("bus_stuck", None)]
