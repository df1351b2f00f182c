"""Runs the system identification on emulated robots, one joint of which has a wrong torque constant.

    python -m verification.torque_constant_trials --backend odrive --first 9000 --trials 8 --record trials.jsonl

Each trial is a suspended robot with five joints of one drive type. One of its drives has a torque constant that differs
by 15 to 40 % from the robot file, in either direction; every fourth robot has no such fault. The number of the robot is
its seed: a robot has the same joint and the same relative error for all drive types.

A trial runs the scenario `identify` in this process: host, command limiter, controller, bus and emulated drives. The
functions of `snakesim robot identify` then evaluate what the host recorded. A trial succeeds if the right joint is
reported to have a wrong torque constant, and no other joint is. `torque_constant_results` prints the table.
"""

import argparse
import random
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ControllerError
from snakesim_hal.model.robot_file.sensors import JointSensor
from snakesim_hal.model.scenario import RunConfig, load_scenario, parse_set_option
from snakesim_hal.programs.single_process import InProcessRun
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Imu
from snakesim_operator.features.commissioning.system_identification.identification import (
    JointIdentification,
)
from snakesim_operator.features.commissioning.system_identification.identify import identify_run
from verification.recorded_trials import append_result, run_missing_trials
from verification.start_check_trials import JOINT_MODULES, TURN_LIMIT_S
from verification.torque_constant_results import (
    JointResult,
    TorqueConstantResult,
    format_failures,
    format_table,
)

JOINT_COUNT = 5
DURATION_S = 12.0  # of a run; the shipped scenario takes 20 s, with which the intervals are shorter
ROBOT_OPTIONS = (
    f"robot.chain.modules={JOINT_COUNT}",
    "robot.motor.friction_nm=0.15",
    "robot.motor.viscous_nm_s_per_rad=0.1",
)
FILE_CONSTANT_NM_PER_A = 0.5
DYNAMIXEL = "dynamixel"
# A smaller constant would need more than the current limit of the servo for the torque limit of the joint.
DYNAMIXEL_CONSTANT_NM_PER_A = 1.78  # of an XM430-W350, stall torque divided by stall current
DYNAMIXEL_RATE_HZ = 150.0  # five servos on a bus of 1 Mbit/s allow at most 155 Hz
MIN_RELATIVE_ERROR = 0.15
MAX_RELATIVE_ERROR = 0.40
ROBOTS_PER_SOUND_ROBOT = 4  # one robot of so many has no fault


def draw_fault(number: int) -> tuple[int, float] | None:
    """Draw the joint with the fault, and the ratio of its true torque constant to that in the robot file.

    Args:
        number: Number of the robot, which is its seed.

    Returns:
        The index of the joint, 0 at the tail, and the ratio; None for a robot without a fault.
    """
    if number % ROBOTS_PER_SOUND_ROBOT == ROBOTS_PER_SOUND_ROBOT - 1:
        return None
    pick = random.Random(number)
    joint_index = pick.randrange(JOINT_COUNT)
    direction = pick.choice((-1, 1))
    return joint_index, 1 + direction * pick.uniform(MIN_RELATIVE_ERROR, MAX_RELATIVE_ERROR)


def identify_torque_constants(number: int, backend: str, *options: str) -> TorqueConstantResult:
    """Run the system identification on one robot, and return what it reports.

    Args:
        number: Number of the robot, which is its seed.
        backend: Backend of the run, which is the type of its drives.
        *options: Further options, as `--set` of a run.
    """
    file_nm_per_a = FILE_CONSTANT_NM_PER_A
    run_options = [f"backend={backend}", f"seed={number + 1}", f"duration_s={DURATION_S}"]
    if backend == DYNAMIXEL:
        file_nm_per_a = DYNAMIXEL_CONSTANT_NM_PER_A
        run_options.append(f"rate_hz={DYNAMIXEL_RATE_HZ}")
    run_options.append(f"robot.motor.torque_constant_nm_per_a={file_nm_per_a}")
    true_nm_per_a = [file_nm_per_a] * JOINT_COUNT
    faulty_joint = None
    fault = draw_fault(number)
    if fault is not None:
        joint_index, ratio = fault
        faulty_joint = f"joint_{joint_index + 1}"
        true_nm_per_a[joint_index] = ratio * file_nm_per_a
        mounted = f"backends.{backend}.mounted.{faulty_joint}"
        run_options.append(f"{mounted}.torque_constant_nm_per_a={true_nm_per_a[joint_index]}")

    texts = [*ROBOT_OPTIONS, *run_options, *options]
    config = load_scenario("identify", [parse_set_option(text) for text in texts]).config
    refusal = ""
    try:
        identified = _run_and_identify(config, number)
    except ControllerError as error:  # drives that do not measure torque
        refusal = str(error)
        identified = [JointIdentification(joint.name, {}, []) for joint in config.robot.joint_table]
    return TorqueConstantResult(
        backend=backend,
        number=number,
        file_nm_per_a=file_nm_per_a,
        faulty_joint=faulty_joint,
        joints=[
            _summarize_joint(joint, true)
            for joint, true in zip(identified, true_nm_per_a, strict=True)
        ],
        refusal=refusal,
    )


def _run_and_identify(config: RunConfig, number: int) -> list[JointIdentification]:
    """Run the scenario in this process, and identify the joints from what the host recorded.

    Raises:
        ControllerError: The drives do not measure torque.
    """
    imus: list[Imu] = []
    rows = b""
    with InProcessRun(config, turn_limit_s=TURN_LIMIT_S) as run:
        imu_reader = run.network.create_session().declare_reader(keys.IMU, Imu)
        black_box = run.host.black_box
        for _ in run.iterate_ticks():
            imus += imu_reader.drain()
            rows += black_box.read_rows(len(rows) // black_box.layout.row_bytes)[1]
        columns: Mapping[str, Floats] = black_box.layout.decode_rows(rows)
        run_config = run.config
    if config.backend != JOINT_MODULES:
        columns = _add_noise(columns, config.robot.sensors.joints, number)
    return identify_run(run_config, columns, imus, f"robot {number}").joints


def _add_noise(columns: Mapping[str, Floats], sensor: JointSensor, seed: int) -> dict[str, Floats]:
    """Add the sensor noise of the robot file to recorded signals: only emulated joint modules have it already."""
    draw_standard_normal = np.random.default_rng(seed).standard_normal
    noisy = dict(columns)
    sigmas = {
        "angle_rad": sensor.angle_noise_rad,
        "velocity_rad_s": sensor.velocity_noise_rad_s,
        "torque_nm": sensor.torque_noise_nm,
    }
    for name, sigma in sigmas.items():
        noisy[name] = columns[name] + sigma * draw_standard_normal(columns[name].shape)
    return noisy


def _summarize_joint(joint: JointIdentification, true_nm_per_a: float) -> JointResult:
    # Values of a joint that does not move as a suspended robot are not written into the robot file.
    constant = None if joint.fails else joint.fields.get("torque_constant_nm_per_a")
    return JointResult(
        joint=joint.joint,
        true_nm_per_a=true_nm_per_a,
        value_nm_per_a=constant.value if constant else None,
        half_width_nm_per_a=constant.half_width if constant else None,
        is_reported=any("torque constant" in reason for reason in joint.wrong),
        reasons=[*joint.wrong, *joint.unknown],
    )


def identify_robots(
    numbers: Iterable[int], backend: str, *options: str, record: Path | None
) -> list[TorqueConstantResult]:
    """Identify robots of one drive type, print a line for each, and return the results.

    Args:
        numbers: Numbers of the robots.
        backend: Backend of the runs.
        *options: Further options, as `--set` of a run.
        record: File to which each result is appended. Robots that it already contains are not identified again.
    """

    def identify_robot(number: int) -> TorqueConstantResult:
        result = identify_torque_constants(number, backend, *options)
        if record is not None:
            append_result(record, result)
        print(
            f"{backend} robot {number}: fault in {result.faulty_joint}, named {result.is_named}, reported falsely "
            f"{result.falsely_reported}, unknown {result.unknown}",
            flush=True,
        )
        return result

    return run_missing_trials(numbers, backend, record, TorqueConstantResult, identify_robot)


def main() -> int:
    """Run the trials of one drive type, and print their table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--backend", default=JOINT_MODULES, help="drive type (default: can)")
    parser.add_argument("--first", type=int, default=1000, help="number of the first robot")
    parser.add_argument("--trials", type=int, default=4, help="number of robots (default: 4)")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        dest="options",
        metavar="PATH=VALUE",
        help="as of a run",
    )
    parser.add_argument(
        "--record",
        type=Path,
        help="file to which each robot is appended; robots that it already contains are not identified again",
    )
    arguments = parser.parse_args()
    numbers = range(arguments.first, arguments.first + arguments.trials)
    results = identify_robots(
        numbers, arguments.backend, *arguments.options, record=arguments.record
    )
    print("\n".join(format_table(results)))
    print("\n".join(format_failures(results)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
