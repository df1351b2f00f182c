"""Emulated robots with a hidden fault, and what the start check and the system identification find of it.

    python -m verification.commissioning_trials check --first 1000 --trials 70 [--backend odrive]
    python -m verification.commissioning_trials identify --first 1000 --trials 70

Every trial is a robot of its own, by its number, which is its seed. The trials of the start check are in
`start_check_trials`, and those of the system identification are below.
"""

import argparse
import random
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from snakesim_drivers.emulation.emulated_body import EmulatedBody
from snakesim_drivers.emulation.mounted import MountedDrive
from snakesim_drivers.emulation.shared_physics import SharedPhysics, make_physics_model
from snakesim_drivers.kit.drive_settings import BodySettings
from snakesim_gnc.control.identify import Identification, IdentifyParameters
from snakesim_hal.base.arrays import Floats
from snakesim_hal.controller import Observation
from snakesim_hal.model.robot_file.robot import describe_robot
from snakesim_hal.model.scenario import RunConfig, load_scenario, parse_set_option
from snakesim_hal.wire.messages import JointMode, JointState
from snakesim_operator.features.commissioning.system_identification.identification import (
    MAX_CONSTANT_ERROR,
    JointIdentification,
    identify_joints,
)
from verification.start_check_results import (
    RobotResult,
    append_trial,
    format_tables,
    read_results,
    summarize_trial,
)
from verification.start_check_trials import (
    BACKLASHES_RAD,
    FAULTS,
    JOINT_COUNT,
    JOINT_MODULES,
    NONE,
    check_trial,
    list_possible_faults,
)

IDENTIFY_MODULES = 5
FILE_CONSTANT_NM_PER_A = 0.5
IDENTIFY_ROBOT = (
    f"robot.chain.modules={IDENTIFY_MODULES}",
    "robot.motor.friction_nm=0.15",
    "robot.motor.viscous_nm_s_per_rad=0.1",
    f"robot.motor.torque_constant_nm_per_a={FILE_CONSTANT_NM_PER_A}",
)
FIELDS = (
    "friction_nm",
    "viscous_nm_s_per_rad",
    "armature_kg_m2",
    "response_time_s",
    "torque_constant_nm_per_a",
)
DRAWN = 0.3  # to either side of the file's value
LATENCY_S = 0.01
IMU_RATE_HZ = 5.0  # of joint modules, one after the other
GYRO_NOISE_RAD_S = 0.005


@dataclass
class IdentifyTrial:
    """One robot, and what was found of it."""

    loose: int | None  # joint with backlash
    truth: Mapping[str, MountedDrive]
    found: Sequence[JointIdentification]
    written: int = field(init=False, default=0)  # values
    # Values that are written, and whose interval covers the truth.
    covered: int = field(init=False, default=0)
    # Torque constants that are written, and off by more than 10 %.
    constants_off: int = field(init=False, default=0)
    # Joints whose torque constant differs by more than 10 % from the file's, and those of them that are reported.
    wrong_constants: int = field(init=False, default=0)
    reported_constants: int = field(init=False, default=0)
    # Joints whose torque constant is reported, although it differs by less.
    falsely_reported_constants: int = field(init=False, default=0)

    def __post_init__(self) -> None:
        """Compare what would be written with the truth."""
        for one in self.found:
            constant = self.truth[one.joint].torque_constant_nm_per_a
            assert constant is not None
            is_reported = any("torque constant" in text for text in one.wrong)
            if abs(constant / FILE_CONSTANT_NM_PER_A - 1) > MAX_CONSTANT_ERROR:
                self.wrong_constants += 1
                self.reported_constants += is_reported
            else:
                self.falsely_reported_constants += is_reported
            if one.fails:
                continue
            for name, value in one.fields.items():
                if name not in FIELDS:
                    continue
                truth = getattr(self.truth[one.joint], name)
                self.written += 1
                self.covered += value.contains(truth)
                self.constants_off += (
                    name == "torque_constant_nm_per_a" and abs(value.value / truth - 1) > 0.1
                )

    @property
    def named(self) -> list[int]:
        """Joints that are reported to have backlash."""
        return find_named_joints(self.found)


def find_named_joints(found: Sequence[JointIdentification]) -> list[int]:
    """Return the indices of the joints that the identification reports to have backlash."""
    return [
        joint for joint, one in enumerate(found) if any("backlash" in text for text in one.unknown)
    ]


@dataclass(frozen=True)
class HiddenRobot:
    """One robot whose drives differ from its file."""

    config: RunConfig
    truth: Mapping[str, MountedDrive]  # by the name of the joint
    latency_s: Sequence[float]  # of each joint, tail to head
    loose: int | None  # joint with backlash


def draw_hidden_robot(number: int, *sets: str, backlash: bool) -> HiddenRobot:
    """Draw the hidden parameters of a robot.

    Args:
        number: Number of the robot, which is its seed.
        *sets: As `--set` of a run.
        backlash: Whether one of its joints has backlash.
    """
    pick = random.Random(number)
    texts = (*IDENTIFY_ROBOT, f"seed={number + 1}", *sets)
    config = load_scenario("identify", [parse_set_option(text) for text in texts]).config
    truth: dict[str, MountedDrive] = {}
    latency_s: list[float] = []
    loose = pick.randrange(len(config.robot.joint_table))
    backlash_rad = pick.choice(BACKLASHES_RAD)
    for joint, one in enumerate(config.robot.joint_table):
        values = {
            name: getattr(one.motor, name) * pick.uniform(1 - DRAWN, 1 + DRAWN) for name in FIELDS
        }
        if backlash and joint == loose:
            values["backlash_rad"] = backlash_rad
        truth[one.name] = MountedDrive(**values)
        latency_s.append(round(LATENCY_S * pick.uniform(1 - DRAWN, 1 + DRAWN), 3))
    return HiddenRobot(config, truth, latency_s, loose if backlash else None)


def identify_trials(number: int, *sets: str, backlash: bool) -> tuple[IdentifyTrial, IdentifyTrial]:
    """Identify a robot whose parameters are hidden: with what its IMUs measured, and without.

    sets: as `--set`. backlash: in one of its joints.
    """
    robot = draw_hidden_robot(number, *sets, backlash=backlash)
    columns, link_rates = record_motion(robot)
    with_imus, without = (
        IdentifyTrial(robot.loose, robot.truth, identify_joints(robot.config, columns, rates))
        for rates in (link_rates, None)
    )
    return with_imus, without


def record_motion(hidden: HiddenRobot) -> tuple[dict[str, Floats], Floats]:
    """Return the columns of a record of the controller on emulated drives, and what the gyros of the links measured.

    Bus and host are left out, so that a hundred trials take minutes. Latencies are whole steps of the physics model.
    """
    config = hidden.config
    truth = hidden.truth
    settings = BodySettings(
        mounted=dict(truth), physics_model_settings=config.backends["can"]["physics_model_settings"]
    )
    physics_model = make_physics_model(config, settings, "can")
    joints = config.robot.joint_table
    body = EmulatedBody(SharedPhysics(config, physics_model, truth, None), range(len(joints)))
    robot = describe_robot(
        config.robot,
        backend="emulator",
        period_ns=config.period_ns,
        lease_ns=config.lease_ns,
        config_hash="",
    )
    controller = Identification(
        robot, msgspec.convert(config.controller_parameters, IdentifyParameters)
    )
    noise = np.random.default_rng(config.seed).standard_normal
    sensor = config.robot.sensors.joints
    sigma = np.array([sensor.angle_noise_rad, sensor.velocity_noise_rad_s, sensor.torque_noise_nm])
    # A drive computes its torque from its current, by the constant that the file says.
    by_file = [joint.motor.torque_constant_nm_per_a or 1.0 for joint in joints]
    in_truth = [joint.motor.torque_constant_nm_per_a or 1.0 for joint in body.joints]
    as_measured = np.array(by_file) / np.array(in_truth)
    period_s = config.period_ns * 1e-9
    steps = round(period_s / physics_model.step_s)
    late = [round(one / physics_model.step_s) for one in hidden.latency_s]
    imu_ticks = round(config.rate_hz / IMU_RATE_HZ)
    waiting: dict[int, list[tuple[int, float]]] = defaultdict(list)  # step -> joint and target
    ticks = round(config.duration_s * config.rate_hz)
    rows: dict[str, list[Any]] = {
        name: [] for name in ("angle_rad", "velocity_rad_s", "torque_nm", "target")
    }
    link_rates = np.full((ticks, len(joints) + 1, 3), np.nan)
    for tick in range(ticks):
        reporting = [i for i in range(len(joints)) if tick % imu_ticks == 7 * i % imu_ticks]
        imu = physics_model.imu() if reporting else None
        if imu is not None:
            for i in reporting:
                rate = np.array(imu.angular_velocity_rad_s[list(imu.link).index(i + 1)])
                link_rates[tick, i + 1] = rate + GYRO_NOISE_RAD_S * noise(3)
        state = np.stack(
            (
                physics_model.angle_rad,
                physics_model.velocity_rad_s,
                body.motors.torque_nm * as_measured,
            )
        )
        angle, velocity, torque = (state + sigma[:, None] * noise(state.shape)).tolist()
        joint_state = JointState(
            tick=tick,
            timestamp_ns=tick * config.period_ns,
            angle_rad=angle,
            velocity_rad_s=velocity,
            torque_nm=torque,
            valid=[True] * len(joints),
            age_ns=[0] * len(joints),
        )
        view = Observation(tick, tick * period_s, period_s, joint_state, None, None)
        target = list(controller.update(view).setpoints.target)
        for name, values in zip(rows, (angle, velocity, torque, target), strict=True):
            rows[name].append(values)
        for i in range(len(joints)):
            waiting[tick * steps + late[i]].append((i, target[i]))
        for step in range(tick * steps, (tick + 1) * steps):
            for i, target_rad in waiting.pop(step, ()):
                motor, limits = joints[i].motor, joints[i].limits
                gains = motor.stiffness_nm_per_rad, motor.damping_nm_s_per_rad, limits.speed_rad_s
                body.drive_motor(i, JointMode.POSITION, target_rad, limits.torque_nm, *gains)
            body.advance_to((step + 1) * physics_model.step_s * 1e6)
    return {name: np.array(values) for name, values in rows.items()}, link_rates


def identify_table(first: int, trial_count: int, *sets: str) -> list[str]:
    """Return the table of trials with backlash in one of five joints, and without, with IMUs and without."""
    lines = [
        "| hidden fault | IMUs | robots | named | named falsely | values written | they cover | constants off "
        "| wrong constants reported | reported falsely |"
    ]
    lines.append("|---|---|---|---|---|---|---|---|---|---|")
    for backlash in (True, False):
        made = [
            identify_trials(number, *sets, backlash=backlash)
            for number in range(first, first + trial_count)
        ]
        for imus, those in zip(("yes", "no"), zip(*made, strict=True), strict=True):
            lines.append(
                f"| {'backlash' if backlash else NONE} | {imus} | {_identified_row(those, backlash=backlash)} |"
            )
    return lines


def _identified_row(trials: Sequence[IdentifyTrial], *, backlash: bool) -> str:
    named = str(sum(trial.loose in trial.named for trial in trials)) if backlash else "-"
    falsely = sum(any(joint != trial.loose for joint in trial.named) for trial in trials)
    written = sum(trial.written for trial in trials)
    covered = sum(trial.covered for trial in trials)
    possible = len(FIELDS) * sum(len(trial.found) for trial in trials)
    off = sum(trial.constants_off for trial in trials)
    share = f"{100 * covered / written:.0f} %" if written else "-"
    reported = sum(trial.reported_constants for trial in trials)
    wrong = sum(trial.wrong_constants for trial in trials)
    falsely_reported = sum(trial.falsely_reported_constants for trial in trials)
    return (
        f"{len(trials)} | {named} | {falsely} | {written} of {possible} | {share} | {off} "
        f"| {reported} of {wrong} | {falsely_reported}"
    )


def check_robots(
    numbers: Iterable[int],
    *sets: str,
    backend: str,
    faults: Sequence[str],
    joint_count: int,
    record: Path | None,
) -> list[RobotResult]:
    """Check robots with each of these faults in turn, print what was found, and return it.

    Args:
        numbers: Numbers of the robots. The number determines the fault, so that all faults are equally frequent.
        *sets: As `--set` of a run.
        backend: Backend of the runs, which is the type of the drives.
        faults: Hidden faults, of `list_possible_faults`.
        joint_count: Number of joints of each robot.
        record: File to which each robot is appended, with its signals in a folder next to it. Robots that it already
            contains are not checked again.
    """
    known_results: dict[int, RobotResult] = {}
    if record is not None:
        known_results = {r.number: r for r in read_results(record) if r.backend == backend}
    results: list[RobotResult] = []
    for number in numbers:
        result = known_results.get(number)
        if result is None:
            fault = faults[number % len(faults)]
            trial = check_trial(number, fault, *sets, backend=backend, joint_count=joint_count)
            result = summarize_trial(trial)
            if record is not None:
                append_trial(record, trial)
            print(
                f"robot {number}, {fault}: {result.outcome}; {result.reported}; blamed {result.blamed}; "
                f"unsure {result.unsure}",
                flush=True,
            )
        results.append(result)
    return results


def main() -> int:
    """Print the table of the check or of the identification."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("table", choices=("check", "identify"))
    parser.add_argument(
        "--first", type=int, default=1000, help="number of the first trial (default: 1000)"
    )
    parser.add_argument("--trials", type=int, default=70, help="default: 70")
    parser.add_argument(
        "--set", action="append", default=[], dest="sets", metavar="PATH=VALUE", help="as of a run"
    )
    parser.add_argument(
        "--backend", default=JOINT_MODULES, help="drive type of the checked robots (default: can)"
    )
    parser.add_argument(
        "--joints",
        type=int,
        default=JOINT_COUNT,
        help=f"number of joints of the checked robots (default: {JOINT_COUNT})",
    )
    parser.add_argument(
        "--fault",
        action="append",
        choices=[*FAULTS, NONE],
        dest="faults",
        help="hidden fault of the checked robots, repeatable: each robot has the next one in turn; the default is "
        "each that the drives can have",
    )
    parser.add_argument(
        "--record",
        type=Path,
        help="file to which each checked robot is appended, with its signals in a folder next to it; robots that it "
        "already contains are not checked again",
    )
    arguments = parser.parse_args()
    if arguments.table == "check":
        results = check_robots(
            range(arguments.first, arguments.first + arguments.trials),
            *arguments.sets,
            backend=arguments.backend,
            faults=arguments.faults or list_possible_faults(arguments.backend),
            joint_count=arguments.joints,
            record=arguments.record,
        )
        lines = list(format_tables(results))
    else:
        lines = identify_table(arguments.first, arguments.trials, *arguments.sets)
    print("\n".join(lines))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
