"""The reference firmware answers as the emulated joint module does, whatever a host sends."""

import random
from pathlib import Path

import pytest

from snakesim_can_backend.emulator import firmware as emulated_firmware
from snakesim_can_backend.protocol.commands import make_command, make_sync
from snakesim_can_backend.protocol.definitions import (
    CanFrame,
    CommandAction,
    LastStop,
    ModuleFault,
    ModuleParameter,
    ModuleState,
)
from snakesim_hal.physics.motor import STEEPEST_ROLL_OFF
from snakesim_hal.physics.thermal import HeatLimits
from snakesim_hal.wire.messages import JointMode
from snakesim_testing.can.firmware_replay import (
    Answer,
    find_difference,
    run_reference,
    run_torques,
    shrink_difference,
)
from snakesim_testing.can.firmware_traffic import NODE, Traffic
from snakesim_testing.can.module_rig import make_parameter_request, make_setpoint

EVENTS_PER_SEED = 2000
SEEDS = range(6)
BOOTED_US = 200_000
RATED_NM = 4.0
RATED_RAD_S = 6.0
HEAT = HeatLimits(80.0, 105.0)


@pytest.mark.parametrize("seed", SEEDS)
def test_emulator_and_reference_agree_on_random_traffic(replay: Path, seed: int) -> None:
    difference = find_difference(replay, Traffic(seed).generate_events(EVENTS_PER_SEED))
    assert difference is None, str(shrink_difference(replay, difference))


def test_random_traffic_reaches_every_state_and_stop_reason(replay: Path) -> None:
    answers: list[Answer] = []
    for seed in SEEDS:
        answers += run_reference(replay, Traffic(seed).generate_events(EVENTS_PER_SEED))
    assert {answer.state for answer in answers} == set(ModuleState)
    assert {answer.mode for answer in answers} == set(JointMode)
    assert {answer.last_stop for answer in answers} == set(LastStop)
    for fault in ModuleFault:
        assert any(answer.faults >> fault & 1 for answer in answers), fault.name


@pytest.mark.parametrize(
    ("constant", "wrong_value"),
    [
        ("MAX_LOST_SETPOINTS", 3),
        ("AT_REST_RAD_S", 0.049),
        ("HEARTBEAT_US", 100_001),
        ("MAX_WRONG_COUNTS", 6),
    ],
)
def test_find_difference_of_wrong_constant_is_shrunk_to_few_events(
    replay: Path, monkeypatch: pytest.MonkeyPatch, constant: str, wrong_value: float
) -> None:
    monkeypatch.setattr(emulated_firmware, constant, wrong_value)
    differences = (
        find_difference(replay, Traffic(seed).generate_events(EVENTS_PER_SEED))
        for seed in range(20)
    )
    difference = next(difference for difference in differences if difference is not None)
    shrunk = shrink_difference(replay, difference)
    assert len(shrunk.events) <= 20, str(shrunk)
    assert not shrunk.emulator.agrees_with(shrunk.reference)


def describe_event(frame: CanFrame, time_us: int) -> str:
    """Return a frame as a line of input of the replay program."""
    return f"frame {time_us} {frame.id:x} {frame.data.hex()}"


def arm_with(parameters: dict[ModuleParameter, float], sensors: str, target: CanFrame) -> list[str]:
    """Return the events after which a module with these parameters follows a setpoint."""
    events = [
        f"init {NODE} 7 {RATED_NM} {RATED_RAD_S} 800 1050 18000 0",
        sensors,
        f"poll {BOOTED_US}",
    ]
    events += [
        describe_event(make_parameter_request(index, value, node_id=NODE), BOOTED_US)
        for index, value in parameters.items()
    ]
    events.append(describe_event(make_command(CommandAction.ARM, NODE), BOOTED_US))
    events.append(describe_event(target, BOOTED_US))
    events.append(describe_event(make_sync(1, 0), BOOTED_US))
    return events


def compute_expected_torque(
    mode: JointMode,
    target: float,
    limit_nm: float,
    angle_rad: float,
    speed_rad_s: float,
    winding_c: float,
) -> tuple[float, bool]:
    """Return the torque that the specification demands, and whether heat reduces it, for the test below."""
    match mode:
        case JointMode.PASSIVE:
            demand_nm = 0.0
        case JointMode.POSITION:
            demand_nm = 20.0 * (target - angle_rad) - 1.5 * speed_rad_s
        case JointMode.VELOCITY:
            demand_nm = 2.0 * (target - speed_rad_s)
        case JointMode.TORQUE:
            demand_nm = target
    stall_nm = STEEPEST_ROLL_OFF * RATED_NM
    reduction_nm = stall_nm * speed_rad_s / 5.0
    demand_nm = min(max(demand_nm, -stall_nm - reduction_nm), stall_nm - reduction_nm)
    limit_nm = min(limit_nm, 3.5)
    commanded_nm = min(max(demand_nm, -limit_nm), limit_nm)
    hot_limit_nm = RATED_NM * HEAT.compute_remaining_fraction(winding_c)
    torque_nm = min(max(commanded_nm, -hot_limit_nm), hot_limit_nm)
    return torque_nm, torque_nm != commanded_nm


def test_reference_firmware_follows_specified_control_law(replay: Path) -> None:
    rng = random.Random(3)
    parameters = {
        ModuleParameter.STIFFNESS: 20.0,
        ModuleParameter.DAMPING: 1.5,
        ModuleParameter.VELOCITY_GAIN: 2.0,
        ModuleParameter.TORQUE_LIMIT: 3.5,
        ModuleParameter.SPEED_LIMIT: 5.0,
    }
    events: list[str] = []
    expected: list[tuple[float, bool]] = []
    for _ in range(300):
        mode = rng.choice(list(JointMode))
        target = 0.0 if mode == JointMode.PASSIVE else round(rng.uniform(-3, 3), 3)
        limit_nm = rng.choice((0.0, 1.0, 3.0, 20.0))
        winding_tenths_c = rng.choice((200, 790, 850, 1000, 1049))
        angle_rad = round(rng.uniform(-3, 3), 3)
        speed_rad_s = round(rng.uniform(-6, 6), 3)
        sensors = f"sensors 1 0 0 0 0 24000 0 {winding_tenths_c} 200" + " 0" * 23
        events += arm_with(parameters, sensors, make_setpoint(0, mode, target, limit_nm, NODE))
        events.append(f"torque {angle_rad} {speed_rad_s}")
        expected.append(
            compute_expected_torque(
                mode, target, limit_nm, angle_rad, speed_rad_s, winding_tenths_c / 10
            )
        )
    measured = run_torques(replay, events)
    assert [torque_nm for torque_nm, _ in measured] == pytest.approx(
        [torque_nm for torque_nm, _ in expected], abs=1e-3
    )
    assert [is_derated for _, is_derated in measured] == [is_derated for _, is_derated in expected]


def test_reference_firmware_without_setpoints_has_no_torque(replay: Path) -> None:
    sensors = "sensors 1 0 0 0 0 24000 0 200 200" + " 0" * 23
    events = arm_with(
        {ModuleParameter.STIFFNESS: 20.0},
        sensors,
        make_setpoint(0, JointMode.POSITION, 1.0, 3.0, NODE),
    )
    events += ["torque 0 0", f"poll {BOOTED_US + 100_000}", "torque 0 0"]
    assert run_torques(replay, events) == [(3.0, False), (0.0, False)]
