"""The complete driver sends setpoints only to an armed robot, and repeats commands until all modules confirm."""

from itertools import pairwise

import pytest

from snakesim_can_backend.protocol.commands import make_command
from snakesim_can_backend.protocol.definitions import (
    BROADCAST,
    CanFrame,
    CommandAction,
    ModuleParameter,
    ModuleState,
    Opcode,
    parse_node,
    parse_opcode,
)
from snakesim_hal.backend import SafeSetpoints
from snakesim_hal.wire.messages import JointMode, LifecycleState
from snakesim_testing.can.driver_loop import JOINT_COUNT, open_driver_loop, reset_and_arm_again
from snakesim_testing.can.frames import decode_signals
from snakesim_testing.can.recording_bus import (
    ARMED,
    DISARMED,
    EMERGENCY,
    WIRES,
    describe_host_frames,
    find_module,
    is_action,
    is_setpoint,
    match_no_frame,
    run_in_lifecycle_state,
)

# --- armed and disarmed robots -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("lifecycle", "first_command", "state", "reset_command"),
    [
        ("disarmed", ["disarm"], DISARMED, []),
        ("fault", ["stop"], DISARMED, ["clear"]),
        ("estop", ["emergency"], EMERGENCY, ["clear"]),
    ],
)
def test_setpoints_are_sent_only_to_armed_robot_until_a_stop(
    lifecycle: LifecycleState,
    first_command: list[str],
    state: ModuleState,
    reset_command: list[str],
) -> None:
    with open_driver_loop() as run:
        run.arm()
        run.run(20, run.wave_joints)
        assert max(run.true_speed_rad_s) > 0.3
        sent = run_in_lifecycle_state(run, lifecycle, 40)
        assert not any(map(is_setpoint, sent))
        commands = describe_host_frames(sent)
        assert commands[:1] == first_command
        assert len(commands) <= 3, "the command is repeated all the time"
        assert run.states() == [state] * JOINT_COUNT
        assert run.true_speed_rad_s[-1] < 0.05
        sent = run_in_lifecycle_state(run, "disarmed")
        assert describe_host_frames(sent)[:1] == reset_command
        reset_and_arm_again(run)
        assert run.faults == []


@pytest.mark.parametrize("latched", ["estop", "fault"])
def test_reset_and_arming_between_two_ticks_arms_the_robot(latched: LifecycleState) -> None:
    with open_driver_loop() as run:
        run.arm()
        run_in_lifecycle_state(run, latched, 25)
        assert describe_host_frames(run_in_lifecycle_state(run, "armed"))[:2] == ["clear", "arm"]
        run.arm()
        run.run(20, run.wave_joints)
        assert run.faults == []
        assert max(run.true_speed_rad_s[-10:]) > 0.1


def test_lost_arming_and_stop_frames_are_sent_again() -> None:
    with open_driver_loop() as run:
        WIRES[0].should_lose = lambda frame: (
            is_action(frame, CommandAction.ARM, CommandAction.STOP)
            and parse_node(frame.id) == BROADCAST
        )
        sent = run_in_lifecycle_state(run, "armed", 6)
        assert describe_host_frames(sent)[:5] == ["arm", "arm 1", "arm 2", "arm 3", "arm 4"]
        assert run.states() == [ARMED] * JOINT_COUNT
        assert run.faults == []
        assert describe_host_frames(run_in_lifecycle_state(run, "fault", 3)) == [
            "stop",
            "stop 1",
            "stop 2",
            "stop 3",
            "stop 4",
        ]
        run_in_lifecycle_state(run, "fault", 20)
        assert run.states() == [DISARMED] * JOINT_COUNT


def test_module_that_disarmed_itself_is_not_armed_again_automatically() -> None:
    with open_driver_loop() as run:
        run_in_lifecycle_state(run, "armed", 3)
        assert run.states() == [ARMED] * JOINT_COUNT
        find_module(run, 2).receive(make_command(CommandAction.DISARM), 0.0)
        sent_before = len(WIRES[0].sent)
        run.run(5)
        assert describe_host_frames(WIRES[0].sent[sent_before:]) == ["stop"]
        assert find_module(run, 2).state == DISARMED
        assert [(fault.what, fault.joint) for fault in run.faults] == [
            ("module_not_armed", "joint_2")
        ]


def test_lost_emergency_frame_is_repeated_until_all_modules_confirm() -> None:
    lost: list[CanFrame] = []

    def lose_some(frame: CanFrame) -> bool:
        lost.extend([frame] * (frame.id == 0))
        return frame.id == 0 and len(lost) < 10

    with open_driver_loop() as run:
        run.arm()
        WIRES[0].should_lose = lose_some
        run_in_lifecycle_state(run, "estop", 10)
        assert run.states() == [EMERGENCY] * JOINT_COUNT
        assert describe_host_frames(run_in_lifecycle_state(run, "estop", 10)) == []


# --- frames that the bus refuses ---------------------------------------------------------------------------------


def test_setpoint_rejected_by_bus_is_replaced_and_never_sent_late() -> None:
    with open_driver_loop() as run:
        run.arm()
        start = run.tick
        refused_ticks = (start + 4, start + 5, start + 9)
        WIRES[0].should_refuse = lambda frame: (
            is_setpoint(frame) and parse_node(frame.id) == 2 and run.tick in refused_ticks
        )
        setpoints_by_tick: dict[int, list[dict[str, float]]] = {}
        for _ in range(30):
            tick = run.tick
            sent_before = len(WIRES[0].sent)
            run.run(
                1,
                lambda tick: SafeSetpoints(
                    [JointMode.POSITION] * 4, [0.001 * (tick - start)] * 4, [4.0] * 4
                ),
            )
            setpoints_by_tick[tick] = [
                decode_signals(frame)
                for frame in WIRES[0].sent[sent_before:]
                if is_setpoint(frame) and parse_node(frame.id) == 2
            ]
        ticks_without_setpoint = [
            tick for tick, setpoints in setpoints_by_tick.items() if not setpoints
        ]
        assert ticks_without_setpoint == list(refused_ticks)
        counts: list[int] = []
        for tick, setpoints in setpoints_by_tick.items():
            if tick in refused_ticks:
                continue
            (setpoint,) = setpoints
            assert setpoint["position"] == pytest.approx(0.001 * (tick - start)), (
                "the setpoint is not the newest one"
            )
            counts.append(int(setpoint["count"]))
        # The setpoints that the bus refused are not counted.
        assert all((b - a) % 16 == 1 for a, b in pairwise(counts))
        assert run.faults == []
        assert run.states() == [ARMED] * JOINT_COUNT


def test_bus_without_sync_is_reported_even_when_disarmed() -> None:
    with open_driver_loop() as run:
        run.run(2)
        WIRES[0].should_refuse = lambda frame: parse_opcode(frame.id) == Opcode.SYNC
        run.run(8)
        # No module is reported as silent.
        assert [fault.what for fault in run.faults] == ["bus_stuck"]
        assert run.samples[-1].joints.valid == [False] * JOINT_COUNT


# --- modules that restart ----------------------------------------------------------------------------------------


def test_restarted_module_is_not_armed_before_its_parameters_are_set() -> None:
    with open_driver_loop(faults=["reboot:joint_2@0.3"]) as run:
        run.arm()
        module = find_module(run, 2)
        run.run(25 - run.tick)
        assert module.state == ARMED
        states: list[ModuleState] = []
        for _ in range(60):
            run.run(1)
            states.append(module.state)
        assert ARMED not in states[states.index(ModuleState.BOOT) :]
        assert module.parameters.values[ModuleParameter.STIFFNESS] == 0.0
        assert "module_restarted" in [fault.what for fault in run.faults]
        assert run.lifecycle == "fault"
        run_in_lifecycle_state(run, "armed", 8)  # the robot is reset and armed between two ticks
        assert run.states() == [ARMED] * JOINT_COUNT
        assert module.parameters.values[ModuleParameter.STIFFNESS] == 40.0


def test_robot_is_not_armed_while_module_rejects_parameters() -> None:
    with open_driver_loop(faults=["reboot:joint_2@0.3"]) as run:
        WIRES[0].should_lose = lambda frame: parse_opcode(frame.id) == Opcode.PARAMETER_REQUEST
        run.run(60)
        assert run.lifecycle == "fault"
        before = len(run.faults)
        sent = run_in_lifecycle_state(run, "armed", 1) + run_in_lifecycle_state(run, "fault", 3)
        assert "clear" in describe_host_frames(sent)
        assert "arm" not in describe_host_frames(sent)
        assert [(fault.what, fault.joint) for fault in run.faults[before:]] == [
            ("module_not_configured", "joint_2")
        ]
        assert ARMED not in run.states()
        WIRES[0].should_lose = match_no_frame
        before = len(run.faults)
        run_in_lifecycle_state(run, "armed", 8)
        assert run.states() == [ARMED] * JOINT_COUNT
        assert run.faults[before:] == []
        assert find_module(run, 2).parameters.values[ModuleParameter.STIFFNESS] == 40.0
