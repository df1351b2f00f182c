"""The module monitor reports each fault once with its joint and cause, and again if it is present after a reset."""

import pytest

from snakesim_can_backend.driver.module_monitor import (
    ARM_GRACE_SYNCS,
    CLEAR_GRACE_SYNCS,
    MAX_FRAMES_PER_CYCLE,
    ROBOT_FAULT_KINDS,
    FaultFinding,
    ModuleMonitor,
)
from snakesim_can_backend.driver.reports import ModuleReports
from snakesim_can_backend.protocol.definitions import LastStop, ModuleState
from snakesim_hal.wire.messages import LifecycleState
from snakesim_testing.can.frames import (
    corrupt_checksum,
    make_heartbeat_frame,
    make_joint_state_frame,
    start_sync,
)
from snakesim_testing.can.monitor_rig import (
    JOINT_2_LABEL,
    OVERHEATED,
    OVERHEATED_WITH_LEAK,
    PERIOD_S,
    MonitorRig,
    Reply,
    list_findings,
    make_heartbeat_reply,
    make_reply,
    send_nothing,
)

# --- faults of one module ----------------------------------------------------------------------------------


def repeat_old_answer(reading: ModuleReports) -> None:
    """Let node 2 answer an old Sync again."""
    reading.process_frame(make_joint_state_frame(2, 2))


def answer_with_wrong_counter(reading: ModuleReports) -> None:
    reading.process_frame(make_joint_state_frame(2, reading.sync + 7))


def answer_with_wrong_checksum(reading: ModuleReports) -> None:
    reading.process_frame(corrupt_checksum(make_joint_state_frame(2, reading.sync)))


def answer_twice(reading: ModuleReports) -> None:
    reading.process_frame(make_joint_state_frame(2, reading.sync))
    reading.process_frame(make_joint_state_frame(2, reading.sync))


def flood_bus(reading: ModuleReports) -> None:
    """Let node 2 answer, and send too many heartbeats."""
    reading.process_frame(make_joint_state_frame(2, reading.sync))
    for _ in range(MAX_FRAMES_PER_CYCLE):
        reading.process_frame(make_heartbeat_frame(2, 1.0))


MODULE_FAULTS = [
    (send_nothing, 3, "module_silent", "is silent: no state for 30 ms"),
    (
        repeat_old_answer,
        3,
        "module_frozen",
        "is frozen: it repeats its answer number 2 to every Sync",
    ),
    (
        answer_with_wrong_counter,
        3,
        "wrong_counter",
        "answers Syncs that were not sent: 3 wrong counters in a row",
    ),
    (
        answer_with_wrong_checksum,
        3,
        "bad_checksum",
        "sends corrupt states: 3 wrong checksums in a row",
    ),
    (
        answer_twice,
        3,
        "duplicate_node",
        "is duplicated: every Sync is answered twice; give each module its own node id",
    ),
    (
        flood_bus,
        1,
        "module_babbling",
        f"floods the bus: {MAX_FRAMES_PER_CYCLE + 1} frames within one period",
    ),
]


@pytest.mark.parametrize(
    ("send_frames", "periods", "what", "cause"),
    MODULE_FAULTS,
    ids=[row[2] for row in MODULE_FAULTS],
)
def test_watch_fault_is_reported_once_and_again_after_reset(
    send_frames: Reply, periods: int, what: str, cause: str
) -> None:
    rig = MonitorRig()
    assert rig.run_ticks(periods - 1, send_frames) == [], "a glitch does not stop the robot"
    assert rig.run_tick(send_frames) == [
        FaultFinding(
            what, JOINT_2_LABEL + cause, 1, affects_only_joint=what not in ROBOT_FAULT_KINDS
        )
    ]
    assert rig.run_ticks(40, send_frames) == []
    rig.reset()
    assert (what, 1) in list_findings(rig.run_ticks(CLEAR_GRACE_SYNCS + 1, send_frames))
    assert rig.run_ticks(40, send_frames) == []


@pytest.mark.parametrize(
    "send_frames",
    [
        send_nothing,
        repeat_old_answer,
        answer_with_wrong_counter,
        answer_with_wrong_checksum,
        answer_twice,
    ],
)
@pytest.mark.parametrize("length", [1, 2])
def test_watch_glitches_report_nothing(send_frames: Reply, length: int) -> None:
    rig = MonitorRig()
    for _ in range(20):
        assert rig.run_ticks(length, send_frames) == []
        assert rig.run_ticks(2) == []


@pytest.mark.parametrize(
    "send_invalid_frame", [answer_with_wrong_checksum, answer_with_wrong_counter]
)
def test_watch_module_with_invalid_frames_is_not_silent(send_invalid_frame: Reply) -> None:
    rig = MonitorRig()
    assert rig.run_ticks(2, send_invalid_frame) == []
    assert rig.run_tick(send_nothing) == []
    assert rig.run_ticks(1) == []


def test_watch_module_never_received_is_reported_only_as_silent() -> None:
    reports = ModuleReports(1)
    monitor = ModuleMonitor(["joint_1"], ["can0"], PERIOD_S)
    findings: list[FaultFinding] = []
    for _ in range(4):
        start_sync(reports)
        findings += monitor.find_faults(reports, "disarmed")
    assert list_findings(findings) == [("module_silent", 0)]
    assert findings[0].cause.endswith("ms")


def test_watch_silent_module_with_heartbeat_differs_from_dead_one() -> None:
    rig = MonitorRig()
    rig.run_tick(lambda reading: reading.process_frame(make_heartbeat_frame(2, 1.0)))
    (finding,) = rig.run_ticks(2, send_nothing)
    assert "it still sends heartbeats" in finding.cause
    rig = MonitorRig()
    rig.run_tick(make_heartbeat_reply())
    (finding,) = rig.run_ticks(3, send_nothing)
    assert "no heartbeat either: power, cable or reset" in finding.cause


# --- restarts ----------------------------------------------------------------------------------------------


def restart_module(rig: MonitorRig) -> list[FaultFinding]:
    """Let node 2 restart, and return the findings."""
    findings: list[FaultFinding] = []
    for uptime_s in (50.0, 0.1, 0.2):
        findings += rig.run_tick(
            make_reply(ModuleState.DISARMED, make_heartbeat_frame(2, uptime_s))
        )
    return findings


def test_watch_restart_is_reported_once_with_joint_and_lost_settings() -> None:
    rig = MonitorRig()
    findings = restart_module(rig) + rig.run_ticks(10)
    assert list_findings(findings) == [("module_restarted", 1)]
    assert findings[0].cause.startswith(JOINT_2_LABEL + "has restarted")
    assert "0.20 s" in findings[0].cause
    assert rig.monitor.pop_changed_joints() == {1}
    assert rig.monitor.pop_changed_joints() == set()
    rig.reset()
    assert rig.run_ticks(10) == []
    assert list_findings(restart_module(rig) + rig.run_ticks(10)) == [("module_restarted", 1)], (
        "the next restart is another fault"
    )


def test_watch_missing_parameters_at_arming_are_reported_once() -> None:
    rig = MonitorRig()
    assert rig.monitor.find_faults(rig.reports, "disarmed", unconfigured_joints={1}) == []
    assert (
        rig.monitor.find_faults(rig.reports, "armed", unconfigured_joints={1}, isolated_joints={1})
        == []
    ), "the joint is isolated"
    (finding,) = rig.monitor.find_faults(rig.reports, "armed", unconfigured_joints={1})
    assert list_findings([finding]) == [("module_not_configured", 1)]
    assert not finding.affects_only_joint
    assert rig.monitor.find_faults(rig.reports, "armed", unconfigured_joints={1}) == []


def test_watch_two_modules_with_one_id_are_no_restart() -> None:
    def send_two_heartbeats(reading: ModuleReports) -> None:
        answer_twice(reading)
        reading.process_frame(make_heartbeat_frame(2, 50.0 + 0.01 * reading.sync))
        reading.process_frame(make_heartbeat_frame(2, 0.01 * reading.sync))

    rig = MonitorRig()
    assert list_findings(rig.run_ticks(30, send_two_heartbeats)) == [("duplicate_node", 1)]
    assert rig.monitor.pop_changed_joints() == set()


def test_watch_restart_after_one_doubled_answer_is_reported() -> None:
    rig = MonitorRig()
    rig.run_tick(answer_twice)
    rig.run_ticks(5)
    assert list_findings(restart_module(rig) + rig.run_ticks(10)) == [("module_restarted", 1)]


def test_watch_isolated_joint_reports_only_robot_wide_faults() -> None:
    rig = MonitorRig()
    rig.isolated = {1}
    assert rig.run_ticks(9, make_reply(ModuleState.FAULT)) == []
    (finding,) = rig.run_ticks(9, OVERHEATED_WITH_LEAK)
    assert finding.what == "module_overheat"
    assert finding.joint == 1
    assert not finding.affects_only_joint


def test_watch_emergency_with_other_fault_concerns_the_robot() -> None:
    rig = MonitorRig()
    rig.isolated = {1}
    report_emergency = make_heartbeat_reply(
        ModuleState.EMERGENCY, last_stop=LastStop.EMERGENCY, fault_overheat=1
    )
    (finding,) = rig.run_ticks(9, report_emergency)
    assert finding.what == "module_overheat"
    assert not finding.affects_only_joint


def test_watch_leak_after_overheating_is_reported_with_all_reasons() -> None:
    rig = MonitorRig()
    (finding,) = rig.run_ticks(9, OVERHEATED)
    assert finding.affects_only_joint
    cause = "reports overheat, leak; it stopped because of overheat"
    assert rig.run_ticks(9, OVERHEATED_WITH_LEAK) == [
        FaultFinding("module_overheat", JOINT_2_LABEL + cause, 1, affects_only_joint=False)
    ]


def test_watch_fault_without_heartbeat_is_reported_from_state() -> None:
    rig = MonitorRig()
    findings = rig.run_ticks(9, make_reply(ModuleState.FAULT))
    assert list_findings(findings) == [("module_fault", 1)]


def test_watch_fault_after_reset_is_reported_after_grace() -> None:
    rig = MonitorRig()
    rig.run_tick(OVERHEATED_WITH_LEAK)
    rig.reset()
    assert rig.run_ticks(CLEAR_GRACE_SYNCS - 1, OVERHEATED_WITH_LEAK) == []
    rig.run_tick(make_heartbeat_reply())
    assert rig.run_ticks(10) == []
    rig.reset()
    assert rig.run_ticks(CLEAR_GRACE_SYNCS - 1, OVERHEATED_WITH_LEAK) == []
    assert list_findings(rig.run_tick(OVERHEATED_WITH_LEAK)) == [("module_overheat", 1)], (
        "a fault that remains is reported again"
    )


@pytest.mark.parametrize(
    ("lifecycle", "expected"), [("estop", []), ("disarmed", [("module_emergency", 1)])]
)
def test_watch_emergency_is_a_fault_unless_robot_is_stopped(
    lifecycle: LifecycleState, expected: list[tuple[str, int]]
) -> None:
    rig = MonitorRig()
    rig.lifecycle = lifecycle
    assert list_findings(rig.run_ticks(9, make_reply(ModuleState.EMERGENCY))) == expected


def test_watch_module_that_does_not_arm_is_reported_after_grace() -> None:
    rig = MonitorRig()
    rig.lifecycle = "armed"
    rig.state = ModuleState.ARMED
    findings_of_ticks = [rig.run_tick(make_reply(ModuleState.DISARMED)) for _ in range(20)]
    first_tick = next(tick for tick, findings in enumerate(findings_of_ticks) if findings)
    assert ARM_GRACE_SYNCS < first_tick <= ARM_GRACE_SYNCS + 3
    assert [finding for findings in findings_of_ticks for finding in findings] == [
        FaultFinding("module_not_armed", JOINT_2_LABEL + "does not arm: it is disarmed", 1)
    ]


def test_watch_module_armed_within_grace_is_not_reported() -> None:
    rig = MonitorRig()
    rig.lifecycle = "armed"
    assert rig.run_ticks(ARM_GRACE_SYNCS) == []
    rig.state = ModuleState.ARMED
    assert rig.run_ticks(10) == []
    assert rig.run_ticks(2, make_reply(ModuleState.STOPPING)) == []
    assert rig.run_ticks(10) == []


def test_watch_module_that_disarms_itself_is_reported_at_once() -> None:
    rig = MonitorRig()
    rig.lifecycle = "armed"
    rig.state = ModuleState.ARMED
    assert rig.run_ticks(2) == [], "the grace period has not ended"
    findings = rig.run_tick(make_reply(ModuleState.DISARMED))
    assert findings == [
        FaultFinding(
            "module_not_armed",
            JOINT_2_LABEL + "is not armed any more: it is disarmed",
            1,
            affects_only_joint=True,
        )
    ]


def test_watch_grace_period_starts_with_every_arming() -> None:
    rig = MonitorRig()
    rig.lifecycle = "armed"
    rig.state = ModuleState.ARMED
    rig.run_ticks(20)
    rig.lifecycle = "disarmed"
    rig.state = ModuleState.DISARMED
    assert rig.run_ticks(20) == [], "modules of a disarmed robot may be disarmed"
    rig.lifecycle = "armed"
    assert rig.run_ticks(ARM_GRACE_SYNCS) == []
