"""Comparing two runs: made-up records whose differences are known beforehand, and the words and pages on them."""

import dataclasses
import json
import math
import re
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.robot_file.robot import add_drive_identities, describe_robot
from snakesim_hal.model.scenario import RunConfig, load_scenario, parse_set_option, write_config
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import ControlState, JointMode
from snakesim_operator.results.compare.command import compare_runs
from snakesim_operator.results.compare.difference import RunDifference, compute_difference
from snakesim_operator.results.compare.page import render_comparison_page
from snakesim_operator.results.compare.table import format_comparison, make_json_values
from snakesim_operator.results.compare.verdict import check_tolerance
from snakesim_operator.results.run_log import RunRecord
from snakesim_testing.messages import raises_error
from snakesim_testing.operator.triplet_report import make_finished_host_record

JOINTS = 13
SPEED_M_S = 0.1


def configured(**changes: Any) -> RunConfig:
    return load_scenario(
        "triplet", [parse_set_option(f"{key}={value}") for key, value in changes.items()]
    ).config


def made_up(
    seconds: float = 2.0,
    rate_hz: float = 100.0,
    start_s: float = 0.5,
    speed_m_s: float = SPEED_M_S,
    propelled: tuple[tuple[float, int], ...] = ((0.0, 9), (0.6, 8), (1.2, 7)),
    controller_knows: bool = True,
) -> RunRecord:
    """Joints that swing, each a little later; no pose, so the controller alone tells how far it came."""
    run = msgspec.structs.replace(configured(), rate_hz=rate_hz, duration_s=seconds)
    count = round(seconds * rate_hz)
    since_s = np.arange(count) / rate_hz
    phase = 2 * math.pi * since_s[:, None] + 0.3 * np.arange(JOINTS)
    joints = [joint.name for joint in describe_of(run).joints]
    control = [
        ControlState(
            tick=row,
            timestamp_ns=round((start_s + t) * 1e9),
            controller="obstacle_triplet",
            state="Locomoting",
            reason="pushing",
            path_s_m=speed_m_s * t if controller_knows else None,
            propulsion_joint=next(
                (joints[j] for at_s, j in reversed(propelled) if at_s <= t + 1e-9), None
            ),
        )
        for row, t in enumerate(since_s.tolist())
    ]
    return RunRecord(
        path=Path("made-up"),
        config=run,
        description=describe_of(run),
        host=make_finished_host_record(count),
        control_states=control,
        worlds=[],
        trajectories=[],
        time_s=start_s + since_s,
        angle_rad=0.3 * np.sin(phase),
        velocity_rad_s=0.6 * math.pi * np.cos(phase),
        torque_nm=2.0 * np.cos(phase),
        mode=np.full((count, JOINTS), JointMode.POSITION, dtype=np.int8),
        target=0.3 * np.sin(phase) + 0.01,
        torque_limit_nm=np.full((count, JOINTS), 7.0),
        position_w_m=np.full((count, 3), np.nan),
        orientation_wxyz=np.full((count, 4), np.nan),
        contact_peak_n=np.zeros(count),
        contact_count=np.zeros(count),
    )


def describe_of(run: RunConfig):
    return describe_robot(
        run.robot, backend="sim", period_ns=run.period_ns, lease_ns=run.lease_ns, config_hash="x"
    )


def shown(difference: RunDifference) -> tuple[str, str]:
    """Table and page; neither may show what is not a number. And for scripts, which get null."""
    values = json.loads(msgspec.json.encode(make_json_values(difference)))
    assert values["identical"] == difference.is_identical
    assert (values["divergence"] is None) == (difference.divergence is None)
    reported = (
        "\n".join(format_comparison(difference)),
        render_comparison_page(difference, check_tolerance(difference, 5)),
    )
    for text in reported:
        assert not re.search(
            r"\b(nan|inf|None)\b",
            re.sub(r"<(style|script)>.*?</\1>|base64,[^\"]*", "", text, flags=re.S),
        )
    return reported


def test_the_same_run_twice_differs_in_nothing() -> None:
    difference = compute_difference(made_up(), made_up())
    assert difference.is_identical
    assert difference.divergence is None
    assert difference.differing_settings == []
    # Angle, speed, torque, angle target.
    assert [gap.rms for gap in difference.quantities] == [0.0] * 4
    assert difference.torque.correlation == pytest.approx(1)
    assert difference.advance is not None
    assert difference.advance.percent == 0
    assert difference.hand_overs.has_same_order
    assert difference.hand_overs.delays_s == [0, 0, 0]
    text, html = shown(difference)
    assert "The runs are the same, joint by joint, for all of their 200 common ticks." in text
    assert "No difference: every angle is the same at every time." in html


@pytest.mark.parametrize("name", ["angle_rad", "velocity_rad_s", "torque_nm", "target"])
@pytest.mark.parametrize(
    ("where", "wrong"), [(np.s_[:], np.nan), (np.s_[50:60, 3], np.nan), (np.s_[:], np.inf)]
)
def test_compare_nan_in_both_runs_is_not_equal(name: str, where: Any, wrong: float) -> None:
    record = made_up()
    hurt = getattr(record, name).copy()
    hurt[where] = wrong
    hurt = dataclasses.replace(record, **{name: hurt})
    for difference in (
        compute_difference(hurt, hurt),
        compute_difference(record, hurt),
        compute_difference(hurt, record),
    ):
        text, html = shown(difference)
        assert not difference.is_identical
        assert "The runs are the same" not in text + html
        assert "Not a number in one run or in both, so it cannot be compared: " in text


ODD: dict[str, dict[str, Any]] = {
    "too few joints": {"angle_rad": np.zeros((200, 5))},
    "too few ticks": {"torque_nm": np.zeros((5, JOINTS))},
    "texts": {"target": np.full((200, JOINTS), "x")},
    "complex": {"velocity_rad_s": np.zeros((200, JOINTS), dtype=complex)},
    "a number": {"mode": np.zeros(())},
    "positions in a plane": {"position_w_m": np.zeros((200, 2))},
    "time that stands": {"time_s": np.zeros(200)},
    "time that is not a number": {"time_s": np.full(200, np.nan)},
}


@pytest.mark.parametrize("odd", ODD)
def test_a_black_box_with_odd_arrays_is_one_error(odd: str) -> None:
    with raises_error(ConfigError, code="recording/not-readable") as caught:
        compute_difference(made_up(), dataclasses.replace(made_up(), **ODD[odd]))
    assert f"`{next(iter(ODD[odd]))}`" in str(caught.value)
    assert "\n" not in str(caught.value)


OFF_JOINT = 4  # joint_5
OFF_FROM_TICK = 120
MOST_OFF_TICK = 150
TICKS = 200  # of the made-up run, at 100 Hz


def compare_with_one_joint_off() -> RunDifference:
    """Compare a run with one in which a joint is off by 0.2 rad from 1.2 s on, and by 0.3 rad at 1.5 s."""
    run = made_up()
    angle_rad = run.angle_rad.copy()
    angle_rad[OFF_FROM_TICK:, OFF_JOINT] += 0.2
    angle_rad[MOST_OFF_TICK, OFF_JOINT] += 0.1
    return compute_difference(run, dataclasses.replace(run, angle_rad=angle_rad))


def test_compare_one_joint_off_has_its_worst_difference() -> None:
    worst = compare_with_one_joint_off().angle.max_difference
    assert worst is not None
    assert worst.joint == OFF_JOINT
    assert worst.time_s == pytest.approx(1.5)
    assert worst.difference == pytest.approx(0.3)


def test_compare_one_joint_off_has_rms_of_this_joint_alone() -> None:
    difference = compare_with_one_joint_off()
    ticks_off_by_02 = TICKS - OFF_FROM_TICK - 1
    rms_rad = math.sqrt((ticks_off_by_02 * 0.2**2 + 0.3**2) / TICKS)
    expected = [rms_rad if joint == OFF_JOINT else 0.0 for joint in range(JOINTS)]
    assert difference.angle.rms_by_joint.tolist() == pytest.approx(expected)
    assert difference.torque.rms == 0


def test_compare_one_joint_off_diverges_at_its_first_difference() -> None:
    difference = compare_with_one_joint_off()
    assert not difference.is_identical
    assert difference.divergence is not None
    assert difference.divergence.joint == OFF_JOINT
    assert difference.divergence.time_s == pytest.approx(1.2)


def test_compare_one_joint_off_is_named_in_text_and_page() -> None:
    text, html = shown(compare_with_one_joint_off())
    assert "The runs diverge at 1.20 s, when joint_5 is first more than 0.05 rad apart." in text
    assert "joint_5 at 1.50 s" in text
    assert 'data-joint="joint_5"' in html


def test_runs_are_aligned_at_their_first_arming_whenever_that_was() -> None:
    difference = compute_difference(made_up(start_s=0.5), made_up(start_s=7.25))
    assert difference.aligned.sampling_description == "tick by tick"
    assert difference.angle.rms == pytest.approx(0, abs=1e-12)
    assert difference.hand_overs.delays_s == pytest.approx([0, 0, 0])


def test_compare_uses_only_the_common_time() -> None:
    difference = compute_difference(made_up(seconds=2), made_up(seconds=1))
    assert difference.aligned.time_s[-1] == pytest.approx(0.99)
    assert difference.is_identical
    # The third comes later than B lasts.
    assert [one.joint_index for one in difference.hand_overs.a] == [9, 8]
    assert [one.key for one in difference.differing_settings] == ["duration_s"]


def test_compare_delayed_run_has_its_delay() -> None:
    a, late = made_up(), 0.05
    since_s = a.time_s[:, None] - a.time_s[0] - late
    b = dataclasses.replace(
        a, angle_rad=0.3 * np.sin(2 * math.pi * since_s + 0.3 * np.arange(JOINTS))
    )
    difference = compute_difference(a, b)
    size = 0.3 * 2 * math.sin(math.pi * late)  # of the difference of two sines
    assert difference.angle.rms == pytest.approx(size / math.sqrt(2), rel=0.01)
    assert difference.angle.correlation == pytest.approx(math.cos(2 * math.pi * late), abs=0.005)


def test_scaled_torques_correlate_fully() -> None:
    a = made_up()
    difference = compute_difference(a, dataclasses.replace(a, torque_nm=1.5 * a.torque_nm))
    assert difference.torque.correlation == pytest.approx(1)
    assert difference.torque.rms == pytest.approx(1.0 / math.sqrt(2), rel=0.01)
    assert difference.torque.max_difference is not None
    assert abs(difference.torque.max_difference.difference) == pytest.approx(1.0, rel=0.01)
    shown(difference)


def test_compare_different_rates_uses_the_coarser_and_says_so() -> None:
    difference = compute_difference(made_up(rate_hz=100), made_up(rate_hz=30, seconds=1.5))
    assert len(difference.aligned.time_s) == 45
    assert (
        difference.aligned.sampling_description
        == "A at 100 Hz, B at 30 Hz: A is interpolated at the ticks of B"
    )
    assert difference.angle.rms is not None
    assert difference.angle.rms < 2e-4  # a sine between 10 ms ticks
    assert {"rate_hz", "duration_s"} <= {one.key for one in difference.differing_settings}
    assert difference.aligned.sampling_description in shown(difference)[0]


def test_a_set_point_holds_until_the_next_one() -> None:
    a = made_up(rate_hz=50)
    b = made_up(rate_hz=40)
    steps = [
        np.repeat(np.floor((r.time_s - 0.5) * 10 + 1e-9)[:, None], JOINTS, axis=1) for r in (a, b)
    ]
    difference = compute_difference(
        dataclasses.replace(a, target=steps[0]), dataclasses.replace(b, target=steps[1])
    )
    assert difference.targets[0].rms == 0


def test_serial_numbers_and_the_order_of_sensors_are_no_settings() -> None:
    """As a simulator and joint modules describe one robot."""
    a, b = made_up(), made_up()
    described = add_drive_identities(
        b.description, [f"AE{i:02d}" for i in range(JOINTS)], ["1.0"] * JOINTS
    )
    imu = next(sensor for sensor in described.sensors if sensor.key == keys.IMU)
    slower = msgspec.structs.replace(imu, rate_hz=5.0)
    sensors = [slower, *(sensor for sensor in reversed(described.sensors) if sensor is not imu)]
    described = msgspec.structs.replace(described, sensors=sensors, simulated_time=True)
    difference = compute_difference(a, dataclasses.replace(b, description=described))
    assert [one.key for one in difference.differing_settings] == [
        f"description.sensors.{keys.IMU}.rate_hz"
    ]
    lines = format_comparison(difference)
    assert "1 setting differs" in lines
    assert (
        "drives: A reports no serial numbers and no firmware versions, B those of 13 of 13 joints"
        in lines
    )
    assert "drives: A reports no serial numbers" in shown(difference)[1]
    assert make_json_values(difference)["drives"]["joint_1"]["b"] == {
        "serial": "AE00",
        "firmware": "1.0",
    }


def test_compare_names_different_drives() -> None:
    a, b = made_up(), made_up()
    of_a = add_drive_identities(a.description, [f"A{i}" for i in range(JOINTS)], ["1.0"] * JOINTS)
    of_b = add_drive_identities(
        a.description, [f"A{i}" for i in range(JOINTS - 1)] + ["B"], ["1.1"] * JOINTS
    )
    difference = compute_difference(
        dataclasses.replace(a, description=of_a), dataclasses.replace(b, description=of_b)
    )
    assert difference.differing_settings == []
    assert (
        "drives: another serial number at 1 of 13 joints, another firmware version at 13"
        in format_comparison(difference)
    )


def test_ticks_that_are_missing_are_told() -> None:
    a = made_up()
    keep = np.arange(200) != 50
    columns = [name for name, value in vars(a).items() if isinstance(value, np.ndarray)]
    difference = compute_difference(
        a, dataclasses.replace(a, **{name: getattr(a, name)[keep] for name in columns})
    )
    assert difference.aligned.sampling_description.startswith(
        "both at 100 Hz, but some ticks are missing"
    )
    assert difference.is_identical


TORQUE_JOINT = 6
TORQUE_FROM_TICK = 100  # 1 s


def made_up_with_torque_joint(torque_nm: float) -> RunRecord:
    """Return the made-up run with one joint in torque mode from 1 s on."""
    run = made_up()
    mode = run.mode.copy()
    mode[TORQUE_FROM_TICK:, TORQUE_JOINT] = JointMode.TORQUE
    target = run.target.copy()
    target[TORQUE_FROM_TICK:, TORQUE_JOINT] = torque_nm
    return dataclasses.replace(run, mode=mode, target=target)


def test_compare_targets_of_different_modes_are_not_compared() -> None:
    difference = compute_difference(made_up(), made_up_with_torque_joint(5.0))
    (angle_target,) = difference.targets
    assert angle_target.quantity == "angle target"
    assert angle_target.rms == 0
    assert not difference.is_identical
    assert difference.other_mode_fraction == pytest.approx(
        (TICKS - TORQUE_FROM_TICK) / (TICKS * JOINTS)
    )
    assert difference.tracking_errors_rad == pytest.approx((0.01, 0.01))


def test_compare_torque_targets_names_worst_joint_and_time() -> None:
    difference = compute_difference(made_up_with_torque_joint(5.0), made_up_with_torque_joint(6.0))
    torque_target = difference.targets[1]
    assert torque_target.quantity == "torque target"
    assert torque_target.max_difference is not None
    assert torque_target.max_difference.joint == TORQUE_JOINT
    assert torque_target.max_difference.time_s == pytest.approx(1.0)
    assert torque_target.max_difference.difference == 1.0
    assert [
        joint
        for joint, worst in enumerate(torque_target.max_difference_by_joint)
        if worst is not None
    ] == [TORQUE_JOINT]
    shown(difference)


@pytest.mark.parametrize(("speed_m_s", "percent"), [(0.09, -10.0), (0.125, 25.0), (-0.1, -200.0)])
def test_distance_is_relative_to_the_first_run(speed_m_s: float, percent: float) -> None:
    difference = compute_difference(made_up(), made_up(speed_m_s=speed_m_s))
    assert difference.advance is not None
    assert difference.advance.percent == pytest.approx(percent)
    asked = check_tolerance(difference, abs(percent) - 0.1)
    assert asked is not None
    assert not asked.holds
    asked = check_tolerance(difference, abs(percent) + 0.1)
    assert asked is not None
    assert asked.holds


def test_compare_standing_run_has_no_relative_distance() -> None:
    stood = made_up(speed_m_s=0)
    both, one = (
        compute_difference(stood, made_up(speed_m_s=1e-5)),
        compute_difference(stood, made_up()),
    )
    assert both.advance is not None
    assert both.advance.percent == 0
    assert one.advance is not None
    assert one.advance.percent is None
    asked = check_tolerance(one, 1000)
    assert asked is not None
    assert not asked.holds
    assert "A did not move" in asked.words
    shown(both)
    shown(one)


def test_compare_unknown_distance_stays_unknown() -> None:
    difference = compute_difference(made_up(), made_up(controller_knows=False))
    assert difference.advance is None
    assert check_tolerance(difference, 10) is None
    text, html = shown(difference)
    assert "no measure that both have" in text
    assert "No distance" in html


def test_compare_hand_overs_agree_until_first_difference() -> None:
    b = made_up(propelled=((0.0, 9), (0.7, 8), (1.1, 6), (1.5, 7)))
    difference = compute_difference(made_up(), b)
    both = difference.hand_overs
    assert both.common_count == 2
    assert both.delays_s == pytest.approx([0, 0.1])
    assert not both.has_same_order
    said = "agrees for the first 2; then A continues with joint_8 at 1.20 s, B continues with joint_7 at 1.10 s"
    text, html = shown(difference)
    assert said in text
    assert said in html


def test_settings_that_differ_are_named_with_both_values() -> None:
    a = made_up()
    b = dataclasses.replace(
        a, config=configured(**{"robot.motor.stiffness_nm_per_rad": 50, "seed": 2})
    )
    found = {one.key: (one.a, one.b) for one in compute_difference(a, b).differing_settings}
    assert found["robot.motor.stiffness_nm_per_rad"] == ("60.0", "50.0")
    assert found["seed"] == ("1", "2")
    assert not [key for key in found if key.startswith("description.")]


def test_a_run_that_never_armed_is_not_compared() -> None:
    a = made_up()
    empty = dataclasses.replace(a, path=Path("idle"), time_s=np.zeros(0))
    with raises_error(ConfigError, code="recording/never-armed", field="blackbox.rows"):
        compute_difference(a, empty)


def test_a_single_common_tick_is_enough() -> None:
    shown(compute_difference(made_up(), made_up(seconds=0.01, controller_knows=False)))


def test_folders_that_hold_no_run_are_named(tmp_path: Path) -> None:
    with raises_error(ConfigError, code="recording/not-a-run"):
        compare_runs(tmp_path / "nowhere", tmp_path)
    with raises_error(ConfigError, code="recording/not-a-run", field="config.json"):
        compare_runs(tmp_path, tmp_path)
    for name in ("config.json", "blackbox.rows", "host.json", "description.json"):
        (tmp_path / name).write_text("{")
    with raises_error(ConfigError, code="file/invalid-syntax", field="config.json"):
        compare_runs(tmp_path, tmp_path)
    write_config(configured(), tmp_path / "config.json")
    with raises_error(ConfigError, code="recording/not-readable"):
        compare_runs(tmp_path, tmp_path)
    (tmp_path / "description.json").write_bytes(msgspec.json.encode(describe_of(configured())))
    with raises_error(ConfigError, code="recording/not-readable", field="blackbox.rows"):
        compare_runs(tmp_path, tmp_path)
    with raises_error(ConfigError, code="command/invalid-option", field="--within"):
        compare_runs(tmp_path, tmp_path, within_percent=-1)
