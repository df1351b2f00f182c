"""What the watch tells of buses, and of who should not be there."""

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
def test_a_bus_that_fails_is_a_fault_of_no_joint(kind: Kind, advice: str) -> None:
    bench = MonitorRig()
    error = BusError(kind, "can0", "transmit errors 200, receive errors 3")
    (found,) = bench.run_tick(errors=[error])
    assert found.what == kind
    assert found.joint is None
    assert found.cause.startswith("can0: transmit errors 200, receive errors 3; ")
    assert advice in found.cause
    assert bench.run_tick(errors=[error]) == []
    assert [f.cause[:5] for f in bench.run_tick(errors=[BusError(kind, "can1", "")])] == [
        "can1:"
    ], "the other bus is new"
    bench.reset()
    assert list_findings(bench.run_tick(errors=[error])) == [(kind, None)]


@pytest.mark.parametrize(
    "kind", ["error_warning", "not_acknowledged", "queue_full", "error_frames", "interface_up"]
)
def test_lesser_errors_are_only_counted(kind: Kind) -> None:
    bench = MonitorRig()
    for _ in range(2):
        assert bench.run_tick(errors=[BusError(kind, "can0", "")]) == []
    assert bench.monitor.minor_error_counts == {kind: 2}


def test_a_bus_that_takes_nothing_for_three_periods_is_stuck() -> None:
    bench = MonitorRig()
    for unsent in ("can1", "can1", "", "can1", "can1"):
        assert bench.run_tick(unsent=unsent) == [], "full for a moment"
    (found,) = bench.run_tick(unsent="can1")
    assert found.what == "bus_stuck"
    assert found.joint is None
    for words in (
        "can1: ",
        "no frames sent for 30 ms",
        "no node acknowledges",
        "txqueuelen is below 64",
    ):
        assert words in found.cause
    assert bench.run_tick(unsent="can1") == []


# --- who should not be there -------------------------------------------------------------------------------


def stranger(reading: ModuleReports) -> None:
    answer_sync(reading, [2])
    reading.process_frame(make_joint_state_frame(9, reading.sync))


def test_a_stranger_that_answers_every_sync_is_found() -> None:
    bench = MonitorRig()
    assert bench.run_ticks(2, stranger) == []
    (found,) = bench.run_tick(stranger)
    assert found == FaultFinding(
        "unknown_node", "node 9 is on the bus, but is not a joint of this robot"
    )
    assert bench.run_ticks(5, stranger) == []


@pytest.mark.parametrize(
    ("frame", "what", "words"),
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
def test_bus_watch_reports_a_second_host(frame: CanFrame, what: str, words: str) -> None:
    bench, speak = MonitorRig(), make_reply(ModuleState.DISARMED, frame)
    (found,) = bench.run_tick(speak)
    assert found.what == what
    assert found.joint is None
    assert words in found.cause
    assert bench.run_tick(speak) == []
    bench.reset()
    assert bench.run_tick() == [], "it was there once and is no more"
    assert list_findings(bench.run_tick(speak)) == [(what, None)]


def test_what_another_host_may_have_changed_is_written_anew() -> None:
    bench = MonitorRig()
    bench.reports.process_frame(
        load_layouts()[Opcode.PARAMETER_REQUEST].encode(2, index=1, operation=1)
    )
    assert list_findings(bench.run_tick()) == [("second_host", None)]
    assert bench.monitor.pop_changed_joints() == {0, 1, 2}


def test_bus_watch_identity_request_is_no_second_host() -> None:
    bench = MonitorRig()
    bench.reports.process_frame(make_command(CommandAction.IDENTIFY))
    assert bench.run_tick() == []
    assert bench.monitor.pop_changed_joints() == set()


def test_a_module_is_not_silent_that_was_not_asked() -> None:
    bench = MonitorRig()
    for i in range(10):
        assert list_findings(bench.run_tick(send_nothing, unsent="can0")) == (
            [("bus_stuck", None)] if i == 2 else []
        )
    assert bench.run_ticks(2, send_nothing) == []
    assert list_findings(bench.run_tick(send_nothing)) == [("module_silent", 1)]


def test_bus_watch_interface_down_is_not_also_reported_stuck() -> None:
    bench = MonitorRig()
    down, up = (BusError(kind, "can1", "") for kind in ("interface_down", "interface_up"))
    assert list_findings(bench.run_tick(errors=[down], unsent="can1")) == [("interface_down", None)]
    for _ in range(10):
        assert bench.run_tick(unsent="can1") == []
    bench.run_tick(errors=[up], unsent="can1")
    found = [f for _ in range(3) for f in bench.run_tick(unsent="can1")]
    assert list_findings(found) == [("bus_stuck", None)]
