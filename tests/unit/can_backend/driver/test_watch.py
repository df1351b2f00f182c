"""Each finding: its word, its joint, where it sends a person; told once, and again when it is still there."""

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

# --- what one module can do wrong --------------------------------------------------------------------------


def frozen(reading: ModuleReports) -> None:
    reading.process_frame(make_joint_state_frame(2, 2))


def miscounting(reading: ModuleReports) -> None:
    reading.process_frame(make_joint_state_frame(2, reading.sync + 7))


def corrupt(reading: ModuleReports) -> None:
    reading.process_frame(corrupt_checksum(make_joint_state_frame(2, reading.sync)))


def doubled(reading: ModuleReports) -> None:
    reading.process_frame(make_joint_state_frame(2, reading.sync))
    reading.process_frame(make_joint_state_frame(2, reading.sync))


def babbling(reading: ModuleReports) -> None:
    reading.process_frame(make_joint_state_frame(2, reading.sync))
    for _ in range(MAX_FRAMES_PER_CYCLE):
        reading.process_frame(make_heartbeat_frame(2, 1.0))


WRONGS = [
    (send_nothing, 3, "module_silent", "is silent: no state for 30 ms"),
    (frozen, 3, "module_frozen", "is frozen: it repeats its answer number 2 to every Sync"),
    (
        miscounting,
        3,
        "wrong_counter",
        "answers Syncs that were not sent: 3 wrong counters in a row",
    ),
    (corrupt, 3, "bad_checksum", "sends corrupt states: 3 wrong checksums in a row"),
    (
        doubled,
        3,
        "duplicate_node",
        "is duplicated: every Sync is answered twice; give each module its own node id",
    ),
    (
        babbling,
        1,
        "module_babbling",
        f"floods the bus: {MAX_FRAMES_PER_CYCLE + 1} frames within one period",
    ),
]


@pytest.mark.parametrize(
    ("speak", "after", "what", "cause"), WRONGS, ids=[row[2] for row in WRONGS]
)
def test_watch_fault_is_reported_once_and_again_after_clearing(
    speak: Reply, after: int, what: str, cause: str
) -> None:
    bench = MonitorRig()
    assert bench.run_ticks(after - 1, speak) == [], "a glitch is nothing to stop for"
    assert bench.run_tick(speak) == [
        FaultFinding(
            what, JOINT_2_LABEL + cause, 1, affects_only_joint=what not in ROBOT_FAULT_KINDS
        )
    ]
    assert bench.run_ticks(40, speak) == []
    bench.reset()
    assert (what, 1) in list_findings(bench.run_ticks(CLEAR_GRACE_SYNCS + 1, speak))
    assert bench.run_ticks(40, speak) == []


@pytest.mark.parametrize("speak", [send_nothing, frozen, miscounting, corrupt, doubled])
@pytest.mark.parametrize("length", [1, 2])
def test_watch_glitches_report_nothing(speak: Reply, length: int) -> None:
    bench = MonitorRig()
    for _ in range(20):
        assert bench.run_ticks(length, speak) == []
        assert bench.run_ticks(2) == []


@pytest.mark.parametrize("bad", [corrupt, miscounting])
def test_watch_module_with_invalid_frames_is_not_silent(bad: Reply) -> None:
    bench = MonitorRig()
    assert bench.run_ticks(2, bad) == []
    assert bench.run_tick(send_nothing) == []
    assert bench.run_ticks(1) == []


def test_watch_module_never_received_is_reported_only_as_silent() -> None:
    reading, watch = ModuleReports(1), ModuleMonitor(["joint_1"], ["can0"], PERIOD_S)
    found = [
        f
        for _ in range(4)
        for f in (start_sync(reading), watch.find_faults(reading, "disarmed"))[1]
    ]
    assert list_findings(found) == [("module_silent", 0)]
    assert found[0].cause.endswith("ms")


def test_watch_silent_module_with_heartbeat_differs_from_dead_one() -> None:
    bench = MonitorRig()
    bench.run_tick(lambda reading: reading.process_frame(make_heartbeat_frame(2, 1.0)))
    (found,) = bench.run_ticks(2, send_nothing)
    assert "it still sends heartbeats" in found.cause
    bench = MonitorRig()
    bench.run_tick(make_heartbeat_reply())
    (found,) = bench.run_ticks(3, send_nothing)
    assert "no heartbeat either: power, cable or reset" in found.cause


# --- restarts ----------------------------------------------------------------------------------------------


def restarting(bench: MonitorRig) -> list[FaultFinding]:
    found: list[FaultFinding] = []
    for uptime_s in (50.0, 0.1, 0.2):
        found += bench.run_tick(make_reply(ModuleState.DISARMED, make_heartbeat_frame(2, uptime_s)))
    return found


def test_watch_restart_is_reported_once_with_joint_and_lost_settings() -> None:
    bench = MonitorRig()
    found = restarting(bench) + bench.run_ticks(10)
    assert list_findings(found) == [("module_restarted", 1)]
    assert found[0].cause.startswith(JOINT_2_LABEL + "has restarted")
    assert "0.20 s" in found[0].cause
    assert bench.monitor.pop_changed_joints() == {1}
    assert bench.monitor.pop_changed_joints() == set()
    bench.reset()
    assert bench.run_ticks(10) == []
    assert list_findings(restarting(bench) + bench.run_ticks(10)) == [("module_restarted", 1)], (
        "the next one is another"
    )


def test_watch_missing_parameters_at_arming_are_reported_once() -> None:
    bench = MonitorRig()
    assert bench.monitor.find_faults(bench.reports, "disarmed", unconfigured_joints={1}) == []
    assert (
        bench.monitor.find_faults(
            bench.reports, "armed", unconfigured_joints={1}, isolated_joints={1}
        )
        == []
    ), "set aside"
    (found,) = bench.monitor.find_faults(bench.reports, "armed", unconfigured_joints={1})
    assert list_findings([found]) == [("module_not_configured", 1)]
    assert not found.affects_only_joint
    assert bench.monitor.find_faults(bench.reports, "armed", unconfigured_joints={1}) == []


def test_two_modules_with_one_id_are_not_called_a_restart() -> None:
    def two_hearts(reading: ModuleReports) -> None:
        doubled(reading)
        reading.process_frame(make_heartbeat_frame(2, 50.0 + 0.01 * reading.sync))
        reading.process_frame(make_heartbeat_frame(2, 0.01 * reading.sync))

    bench = MonitorRig()
    assert list_findings(bench.run_ticks(30, two_hearts)) == [("duplicate_node", 1)]
    assert bench.monitor.pop_changed_joints() == set()


def test_after_one_doubled_frame_a_restart_is_still_seen() -> None:
    bench = MonitorRig()
    bench.run_tick(doubled)
    bench.run_ticks(5)
    assert list_findings(restarting(bench) + bench.run_ticks(10)) == [("module_restarted", 1)]


def test_watch_isolated_joint_reports_only_robot_wide_faults() -> None:
    bench = MonitorRig()
    bench.isolated = {1}
    assert bench.run_ticks(9, make_reply(ModuleState.FAULT)) == []
    (found,) = bench.run_ticks(9, OVERHEATED_WITH_LEAK)
    assert found.what == "module_overheat"
    assert found.joint == 1
    assert not found.affects_only_joint


def test_an_emergency_concerns_all_whatever_else_is_wrong() -> None:
    bench = MonitorRig()
    bench.isolated = {1}
    stopped = make_heartbeat_reply(
        ModuleState.EMERGENCY, last_stop=LastStop.EMERGENCY, fault_overheat=1
    )
    (found,) = bench.run_ticks(9, stopped)
    assert found.what == "module_overheat"
    assert not found.affects_only_joint


def test_water_after_heat_is_told_again_with_all_reasons() -> None:
    bench = MonitorRig()
    (found,) = bench.run_ticks(9, OVERHEATED)
    assert found.affects_only_joint
    reasons = "reports overheat, leak; it stopped because of overheat"
    assert bench.run_ticks(9, OVERHEATED_WITH_LEAK) == [
        FaultFinding("module_overheat", JOINT_2_LABEL + reasons, 1, affects_only_joint=False)
    ]


def test_watch_fault_without_heartbeat_is_reported_from_state() -> None:
    bench = MonitorRig()
    found = bench.run_ticks(9, make_reply(ModuleState.FAULT))
    assert list_findings(found) == [("module_fault", 1)]


def test_a_modules_fault_has_time_to_go_after_a_clearing() -> None:
    bench = MonitorRig()
    bench.run_tick(OVERHEATED_WITH_LEAK)
    bench.reset()
    assert bench.run_ticks(CLEAR_GRACE_SYNCS - 1, OVERHEATED_WITH_LEAK) == []
    bench.run_tick(make_heartbeat_reply())
    assert bench.run_ticks(10) == []
    bench.reset()
    assert bench.run_ticks(CLEAR_GRACE_SYNCS - 1, OVERHEATED_WITH_LEAK) == []
    assert list_findings(bench.run_tick(OVERHEATED_WITH_LEAK)) == [("module_overheat", 1)], (
        "and is told again when it stays"
    )


@pytest.mark.parametrize(
    ("lifecycle", "reported"), [("estop", []), ("disarmed", [("module_emergency", 1)])]
)
def test_an_emergency_is_as_it_should_be_only_in_one(
    lifecycle: LifecycleState, reported: list[tuple[str, int]]
) -> None:
    bench = MonitorRig()
    bench.lifecycle = lifecycle
    assert list_findings(bench.run_ticks(9, make_reply(ModuleState.EMERGENCY))) == reported


def test_watch_module_that_does_not_arm_is_reported_after_grace() -> None:
    bench = MonitorRig()
    bench.lifecycle, bench.state = "armed", ModuleState.ARMED
    found = [bench.run_tick(make_reply(ModuleState.DISARMED)) for _ in range(20)]
    first = next(i for i, reported in enumerate(found) if reported)
    assert ARM_GRACE_SYNCS < first <= ARM_GRACE_SYNCS + 3
    assert [f for reported in found for f in reported] == [
        FaultFinding("module_not_armed", JOINT_2_LABEL + "does not arm: it is disarmed", 1)
    ]


def test_watch_module_armed_within_grace_is_not_reported() -> None:
    bench = MonitorRig()
    bench.lifecycle = "armed"
    assert bench.run_ticks(ARM_GRACE_SYNCS) == []
    bench.state = ModuleState.ARMED
    assert bench.run_ticks(10) == []
    assert bench.run_ticks(2, make_reply(ModuleState.STOPPING)) == []
    assert bench.run_ticks(10) == []


def test_watch_module_that_disarms_itself_is_reported_at_once() -> None:
    bench = MonitorRig()
    bench.lifecycle, bench.state = "armed", ModuleState.ARMED
    assert bench.run_ticks(2) == [], "within the grace"
    found = bench.run_tick(make_reply(ModuleState.DISARMED))
    assert found == [
        FaultFinding(
            "module_not_armed",
            JOINT_2_LABEL + "is not armed any more: it is disarmed",
            1,
            affects_only_joint=True,
        )
    ]


def test_the_grace_begins_with_every_arming() -> None:
    bench = MonitorRig()
    bench.lifecycle, bench.state = "armed", ModuleState.ARMED
    bench.run_ticks(20)
    bench.lifecycle, bench.state = "disarmed", ModuleState.DISARMED
    assert bench.run_ticks(20) == [], "disarmed modules of a disarmed robot"
    bench.lifecycle = "armed"
    assert bench.run_ticks(ARM_GRACE_SYNCS) == []
