"""Compares pairs of synthetic runs whose differences are known, and checks the figures, texts and pages."""

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
from snakesim_hal.wire.messages import ControlState, JointMode, RobotDescription
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
ARM_TIME_S = 0.5  # robot time at which a synthetic run is armed


def load_triplet_config(**changes: Any) -> RunConfig:
    """Load the scenario `triplet` with these values changed."""
    return load_scenario(
        "triplet", [parse_set_option(f"{key}={value}") for key, value in changes.items()]
    ).config


def make_run(
    seconds: float = 2.0,
    rate_hz: float = 100.0,
    start_s: float = ARM_TIME_S,
    speed_m_s: float = SPEED_M_S,
    propulsion_joints: tuple[tuple[float, int], ...] = ((0.0, 9), (0.6, 8), (1.2, 7)),
    reports_path: bool = True,
) -> RunRecord:
    """Make the record of a run in which each joint swings as a sine, a little later than the joint before it.

    The record contains no pose, so only the controller's path shows the distance.

    Args:
        seconds: duration of the run.
        rate_hz: ticks in each second.
        start_s: robot time at which the run is armed.
        speed_m_s: speed along the path that the controller reports.
        propulsion_joints: when each propulsion joint takes over, in s from the start, and its index.
        reports_path: whether the controller reports its path.
    """
    config = msgspec.structs.replace(load_triplet_config(), rate_hz=rate_hz, duration_s=seconds)
    description = describe_run_robot(config)
    joint_names = [joint.name for joint in description.joints]
    tick_count = round(seconds * rate_hz)
    elapsed_s = np.arange(tick_count) / rate_hz
    phase_rad = 2 * math.pi * elapsed_s[:, None] + 0.3 * np.arange(JOINTS)

    def find_propulsion_joint(time_s: float) -> str | None:
        """Return the name of the joint that propels the robot at this time after the start."""
        for takeover_s, joint in reversed(propulsion_joints):
            if takeover_s <= time_s + 1e-9:
                return joint_names[joint]
        return None

    control_states = [
        ControlState(
            tick=tick,
            timestamp_ns=round((start_s + time_s) * 1e9),
            controller="obstacle_triplet",
            state="Locomoting",
            reason="pushing",
            path_s_m=speed_m_s * time_s if reports_path else None,
            propulsion_joint=find_propulsion_joint(time_s),
        )
        for tick, time_s in enumerate(elapsed_s.tolist())
    ]
    return RunRecord(
        path=Path("made-up"),
        config=config,
        description=description,
        host=make_finished_host_record(tick_count),
        control_states=control_states,
        worlds=[],
        trajectories=[],
        time_s=start_s + elapsed_s,
        angle_rad=0.3 * np.sin(phase_rad),
        velocity_rad_s=0.6 * math.pi * np.cos(phase_rad),
        torque_nm=2.0 * np.cos(phase_rad),
        mode=np.full((tick_count, JOINTS), JointMode.POSITION, dtype=np.int8),
        target=0.3 * np.sin(phase_rad) + 0.01,
        torque_limit_nm=np.full((tick_count, JOINTS), 7.0),
        position_w_m=np.full((tick_count, 3), np.nan),
        orientation_wxyz=np.full((tick_count, 4), np.nan),
        contact_peak_n=np.zeros(tick_count),
        contact_count=np.zeros(tick_count),
    )


def describe_run_robot(config: RunConfig) -> RobotDescription:
    """Return the description that the host of a simulated run publishes."""
    return describe_robot(
        config.robot,
        backend="sim",
        period_ns=config.period_ns,
        lease_ns=config.lease_ns,
        config_hash="x",
    )


def render_and_check(difference: RunDifference) -> tuple[str, str]:
    """Return the table and the page of a difference, after a check that neither shows a NaN.

    The values for scripts are checked, too: they contain null for each missing value.
    """
    values = json.loads(msgspec.json.encode(make_json_values(difference)))
    assert values["identical"] == difference.is_identical
    assert (values["divergence"] is None) == (difference.divergence is None)
    table = "\n".join(format_comparison(difference))
    page = render_comparison_page(difference, check_tolerance(difference, 5))
    for text in (table, page):
        assert not re.search(
            r"\b(nan|inf|None)\b",
            re.sub(r"<(style|script)>.*?</\1>|base64,[^\"]*", "", text, flags=re.S),
        )
    return table, page


def test_compare_run_with_itself_has_no_difference() -> None:
    difference = compute_difference(make_run(), make_run())
    assert difference.is_identical
    assert difference.divergence is None
    assert difference.differing_settings == []
    # The four quantities are angle, speed, torque and angle target.
    assert [quantity.rms for quantity in difference.quantities] == [0.0] * 4
    assert difference.torque.correlation == pytest.approx(1)
    assert difference.advance is not None
    assert difference.advance.percent == 0
    assert difference.hand_overs.has_same_order
    assert difference.hand_overs.delays_s == [0, 0, 0]
    text, html = render_and_check(difference)
    assert "The runs are the same, joint by joint, for all of their 200 common ticks." in text
    assert "No difference: every angle is the same at every time." in html


@pytest.mark.parametrize("name", ["angle_rad", "velocity_rad_s", "torque_nm", "target"])
@pytest.mark.parametrize(
    ("where", "wrong"), [(np.s_[:], np.nan), (np.s_[50:60, 3], np.nan), (np.s_[:], np.inf)]
)
def test_compare_nan_in_both_runs_is_not_equal(name: str, where: Any, wrong: float) -> None:
    record = make_run()
    values = getattr(record, name).copy()
    values[where] = wrong
    damaged = dataclasses.replace(record, **{name: values})
    for difference in (
        compute_difference(damaged, damaged),
        compute_difference(record, damaged),
        compute_difference(damaged, record),
    ):
        text, html = render_and_check(difference)
        assert not difference.is_identical
        assert "The runs are the same" not in text + html
        assert "Not a number in one run or in both, so it cannot be compared: " in text


INVALID_ARRAYS: dict[str, dict[str, Any]] = {
    "too few joints": {"angle_rad": np.zeros((200, 5))},
    "too few ticks": {"torque_nm": np.zeros((5, JOINTS))},
    "texts": {"target": np.full((200, JOINTS), "x")},
    "complex": {"velocity_rad_s": np.zeros((200, JOINTS), dtype=complex)},
    "a number": {"mode": np.zeros(())},
    "positions in a plane": {"position_w_m": np.zeros((200, 2))},
    "constant time": {"time_s": np.zeros(200)},
    "time that is not a number": {"time_s": np.full(200, np.nan)},
}


@pytest.mark.parametrize("name", INVALID_ARRAYS)
def test_compare_black_box_with_invalid_array_raises_one_error(name: str) -> None:
    invalid = INVALID_ARRAYS[name]
    with raises_error(ConfigError, code="recording/not-readable") as caught:
        compute_difference(make_run(), dataclasses.replace(make_run(), **invalid))
    (field,) = invalid
    assert f"`{field}`" in str(caught.value)
    assert "\n" not in str(caught.value)


OFF_JOINT = 4  # joint_5
OFF_FROM_TICK = 120
MOST_OFF_TICK = 150
TICKS = 200  # of the synthetic run, at 100 Hz


def compare_with_one_joint_off() -> RunDifference:
    """Compare a run with one in which a joint is off by 0.2 rad from 1.2 s on, and by 0.3 rad at 1.5 s."""
    run = make_run()
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
    text, html = render_and_check(compare_with_one_joint_off())
    assert "The runs diverge at 1.20 s, when joint_5 is first more than 0.05 rad apart." in text
    assert "joint_5 at 1.50 s" in text
    assert 'data-joint="joint_5"' in html


def test_compare_runs_armed_at_different_times_aligns_at_first_arming() -> None:
    difference = compute_difference(make_run(start_s=0.5), make_run(start_s=7.25))
    assert difference.aligned.sampling_description == "tick by tick"
    assert difference.angle.rms == pytest.approx(0, abs=1e-12)
    assert difference.hand_overs.delays_s == pytest.approx([0, 0, 0])


def test_compare_uses_only_the_common_time() -> None:
    difference = compute_difference(make_run(seconds=2), make_run(seconds=1))
    assert difference.aligned.time_s[-1] == pytest.approx(0.99)
    assert difference.is_identical
    # Run B ends before the third hand-over.
    assert [hand_over.joint_index for hand_over in difference.hand_overs.a] == [9, 8]
    assert [setting.key for setting in difference.differing_settings] == ["duration_s"]


def test_compare_delayed_run_has_its_delay() -> None:
    delay_s = 0.05
    a = make_run()
    delayed_s = a.time_s[:, None] - a.time_s[0] - delay_s
    b = dataclasses.replace(
        a, angle_rad=0.3 * np.sin(2 * math.pi * delayed_s + 0.3 * np.arange(JOINTS))
    )
    difference = compute_difference(a, b)
    # The difference of two sines is a sine with this amplitude.
    amplitude_rad = 0.3 * 2 * math.sin(math.pi * delay_s)
    assert difference.angle.rms == pytest.approx(amplitude_rad / math.sqrt(2), rel=0.01)
    assert difference.angle.correlation == pytest.approx(math.cos(2 * math.pi * delay_s), abs=0.005)


def test_compare_scaled_torques_have_full_correlation() -> None:
    a = make_run()
    difference = compute_difference(a, dataclasses.replace(a, torque_nm=1.5 * a.torque_nm))
    assert difference.torque.correlation == pytest.approx(1)
    assert difference.torque.rms == pytest.approx(1.0 / math.sqrt(2), rel=0.01)
    assert difference.torque.max_difference is not None
    assert abs(difference.torque.max_difference.difference) == pytest.approx(1.0, rel=0.01)
    render_and_check(difference)


def test_compare_different_rates_uses_and_reports_the_lower_rate() -> None:
    difference = compute_difference(make_run(rate_hz=100), make_run(rate_hz=30, seconds=1.5))
    assert len(difference.aligned.time_s) == 45
    assert (
        difference.aligned.sampling_description
        == "A at 100 Hz, B at 30 Hz: A is interpolated at the ticks of B"
    )
    assert difference.angle.rms is not None
    assert difference.angle.rms < 2e-4  # a sine between 10 ms ticks
    assert {"rate_hz", "duration_s"} <= {setting.key for setting in difference.differing_settings}
    text, _ = render_and_check(difference)
    assert difference.aligned.sampling_description in text


def test_compare_setpoint_applies_until_the_next_one() -> None:
    a = make_run(rate_hz=50)
    b = make_run(rate_hz=40)

    def set_step_targets(run: RunRecord) -> RunRecord:
        """Replace the targets by steps at a rate of 10 Hz, which both runs can represent."""
        steps = np.floor((run.time_s - ARM_TIME_S) * 10 + 1e-9)
        return dataclasses.replace(run, target=np.repeat(steps[:, None], JOINTS, axis=1))

    difference = compute_difference(set_step_targets(a), set_step_targets(b))
    assert difference.targets[0].rms == 0


def test_compare_serial_numbers_and_sensor_order_are_no_settings() -> None:
    """A simulator and joint modules describe the same robot in these two ways."""
    a = make_run()
    b = make_run()
    described = add_drive_identities(
        b.description, [f"AE{i:02d}" for i in range(JOINTS)], ["1.0"] * JOINTS
    )
    imu = next(sensor for sensor in described.sensors if sensor.key == keys.IMU)
    slower = msgspec.structs.replace(imu, rate_hz=5.0)
    sensors = [slower, *(sensor for sensor in reversed(described.sensors) if sensor is not imu)]
    described = msgspec.structs.replace(described, sensors=sensors, simulated_time=True)
    difference = compute_difference(a, dataclasses.replace(b, description=described))
    assert [setting.key for setting in difference.differing_settings] == [
        f"description.sensors.{keys.IMU}.rate_hz"
    ]
    lines = format_comparison(difference)
    assert "1 setting differs" in lines
    assert (
        "drives: A reports no serial numbers and no firmware versions, B those of 13 of 13 joints"
        in lines
    )
    assert "drives: A reports no serial numbers" in render_and_check(difference)[1]
    assert make_json_values(difference)["drives"]["joint_1"]["b"] == {
        "serial": "AE00",
        "firmware": "1.0",
    }


def test_compare_names_different_drives() -> None:
    a = make_run()
    b = make_run()
    description_a = add_drive_identities(
        a.description, [f"A{i}" for i in range(JOINTS)], ["1.0"] * JOINTS
    )
    description_b = add_drive_identities(
        a.description, [f"A{i}" for i in range(JOINTS - 1)] + ["B"], ["1.1"] * JOINTS
    )
    difference = compute_difference(
        dataclasses.replace(a, description=description_a),
        dataclasses.replace(b, description=description_b),
    )
    assert difference.differing_settings == []
    assert (
        "drives: another serial number at 1 of 13 joints, another firmware version at 13"
        in format_comparison(difference)
    )


def test_compare_run_with_missing_tick_reports_it() -> None:
    a = make_run()
    kept = np.arange(TICKS) != 50
    columns = [name for name, value in vars(a).items() if isinstance(value, np.ndarray)]
    difference = compute_difference(
        a, dataclasses.replace(a, **{name: getattr(a, name)[kept] for name in columns})
    )
    assert difference.aligned.sampling_description.startswith(
        "both at 100 Hz, but some ticks are missing"
    )
    assert difference.is_identical


TORQUE_JOINT = 6
TORQUE_FROM_TICK = 100  # 1 s


def make_run_with_torque_joint(torque_nm: float) -> RunRecord:
    """Return the synthetic run with one joint in torque mode from 1 s on."""
    run = make_run()
    mode = run.mode.copy()
    mode[TORQUE_FROM_TICK:, TORQUE_JOINT] = JointMode.TORQUE
    target = run.target.copy()
    target[TORQUE_FROM_TICK:, TORQUE_JOINT] = torque_nm
    return dataclasses.replace(run, mode=mode, target=target)


def test_compare_targets_of_different_modes_are_not_compared() -> None:
    difference = compute_difference(make_run(), make_run_with_torque_joint(5.0))
    (angle_target,) = difference.targets
    assert angle_target.quantity == "angle target"
    assert angle_target.rms == 0
    assert not difference.is_identical
    assert difference.other_mode_fraction == pytest.approx(
        (TICKS - TORQUE_FROM_TICK) / (TICKS * JOINTS)
    )
    assert difference.tracking_errors_rad == pytest.approx((0.01, 0.01))


def test_compare_torque_targets_names_worst_joint_and_time() -> None:
    difference = compute_difference(
        make_run_with_torque_joint(5.0), make_run_with_torque_joint(6.0)
    )
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
    render_and_check(difference)


@pytest.mark.parametrize(("speed_m_s", "percent"), [(0.09, -10.0), (0.125, 25.0), (-0.1, -200.0)])
def test_compare_distance_is_relative_to_the_first_run(speed_m_s: float, percent: float) -> None:
    difference = compute_difference(make_run(), make_run(speed_m_s=speed_m_s))
    assert difference.advance is not None
    assert difference.advance.percent == pytest.approx(percent)
    exceeded = check_tolerance(difference, abs(percent) - 0.1)
    assert exceeded is not None
    assert not exceeded.holds
    kept = check_tolerance(difference, abs(percent) + 0.1)
    assert kept is not None
    assert kept.holds


def test_compare_stationary_run_has_no_relative_distance() -> None:
    stationary = make_run(speed_m_s=0)
    both_stationary = compute_difference(stationary, make_run(speed_m_s=1e-5))
    only_b_moves = compute_difference(stationary, make_run())
    assert both_stationary.advance is not None
    assert both_stationary.advance.percent == 0
    assert only_b_moves.advance is not None
    assert only_b_moves.advance.percent is None
    verdict = check_tolerance(only_b_moves, 1000)
    assert verdict is not None
    assert not verdict.holds
    assert "A did not move" in verdict.words
    render_and_check(both_stationary)
    render_and_check(only_b_moves)


def test_compare_unknown_distance_stays_unknown() -> None:
    difference = compute_difference(make_run(), make_run(reports_path=False))
    assert difference.advance is None
    assert check_tolerance(difference, 10) is None
    text, html = render_and_check(difference)
    assert "no measure that both have" in text
    assert "No distance" in html


def test_compare_hand_overs_agree_until_first_difference() -> None:
    b = make_run(propulsion_joints=((0.0, 9), (0.7, 8), (1.1, 6), (1.5, 7)))
    difference = compute_difference(make_run(), b)
    hand_overs = difference.hand_overs
    assert hand_overs.common_count == 2
    assert hand_overs.delays_s == pytest.approx([0, 0.1])
    assert not hand_overs.has_same_order
    expected = "agrees for the first 2; then A continues with joint_8 at 1.20 s, B continues with joint_7 at 1.10 s"
    text, html = render_and_check(difference)
    assert expected in text
    assert expected in html


def test_compare_different_settings_are_named_with_both_values() -> None:
    a = make_run()
    b = dataclasses.replace(
        a, config=load_triplet_config(**{"robot.motor.stiffness_nm_per_rad": 50, "seed": 2})
    )
    settings = {
        setting.key: (setting.a, setting.b)
        for setting in compute_difference(a, b).differing_settings
    }
    assert settings["robot.motor.stiffness_nm_per_rad"] == ("60.0", "50.0")
    assert settings["seed"] == ("1", "2")
    assert not [key for key in settings if key.startswith("description.")]


def test_compare_run_that_never_armed_is_refused() -> None:
    armed = make_run()
    never_armed = dataclasses.replace(armed, path=Path("idle"), time_s=np.zeros(0))
    with raises_error(ConfigError, code="recording/never-armed", field="blackbox.rows"):
        compute_difference(armed, never_armed)


def test_compare_runs_with_one_common_tick_succeeds() -> None:
    render_and_check(compute_difference(make_run(), make_run(seconds=0.01, reports_path=False)))


def test_compare_folder_that_does_not_exist_is_refused(tmp_path: Path) -> None:
    with raises_error(ConfigError, code="recording/not-a-run"):
        compare_runs(run_a=tmp_path / "nowhere", run_b=tmp_path)


def test_compare_folder_without_run_config_is_refused(tmp_path: Path) -> None:
    empty_folder = tmp_path
    with raises_error(ConfigError, code="recording/not-a-run", field="config.json"):
        compare_runs(run_a=empty_folder, run_b=empty_folder)


def write_run_with_truncated_files(folder: Path, *, intact: frozenset[str] = frozenset()) -> None:
    """Write the files of a run, of which all but the intact ones end after their first character.

    Args:
        folder: Folder of the run.
        intact: Names of the files that are complete: "config.json", or also "description.json".
    """
    for name in ("config.json", "blackbox.rows", "host.json", "description.json"):
        (folder / name).write_text("{")
    config = load_triplet_config()
    if "config.json" in intact:
        write_config(config, folder / "config.json")
    if "description.json" in intact:
        description = describe_run_robot(config)
        (folder / "description.json").write_bytes(msgspec.json.encode(description))


def test_compare_run_with_truncated_config_is_refused(tmp_path: Path) -> None:
    write_run_with_truncated_files(tmp_path)
    with raises_error(ConfigError, code="file/invalid-syntax", field="config.json"):
        compare_runs(run_a=tmp_path, run_b=tmp_path)


def test_compare_run_with_truncated_description_is_refused(tmp_path: Path) -> None:
    write_run_with_truncated_files(tmp_path, intact=frozenset({"config.json"}))
    with raises_error(ConfigError, code="recording/not-readable"):
        compare_runs(run_a=tmp_path, run_b=tmp_path)


def test_compare_run_with_truncated_black_box_is_refused(tmp_path: Path) -> None:
    write_run_with_truncated_files(tmp_path, intact=frozenset({"config.json", "description.json"}))
    with raises_error(ConfigError, code="recording/not-readable", field="blackbox.rows"):
        compare_runs(run_a=tmp_path, run_b=tmp_path)


def test_compare_negative_tolerance_is_refused_before_runs_are_read(tmp_path: Path) -> None:
    unreadable_run = tmp_path / "nowhere"
    with raises_error(ConfigError, code="command/invalid-option", field="--within"):
        compare_runs(run_a=unreadable_run, run_b=unreadable_run, within_percent=-1)
