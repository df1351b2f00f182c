"""Trials of the system identification on emulated robots whose drives differ from their robot file.

    python -m verification.commissioning_trials identify --first 1000 --trials 70

The number of a robot is its seed. For every joint it draws friction, rotor inertia, response time, torque constant and
latency, each within 30 % of the robot file. One joint may also have backlash. The controller of the scenario `identify`
moves emulated drives without a bus and without a host, so that a hundred trials take minutes. Then the joints are
identified twice: with the gyros of the links, and without.

The table shows whether the joint with backlash was reported, whether the 95 % intervals contain the true values, and
whether wrong torque constants were reported. `torque_constant_trials` tests the whole chain, with a bus.
"""

import random
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from snakesim_drivers.emulation.mounted import MountedDrive
from snakesim_drivers.emulation.shared_physics import SharedPhysics, make_physics_model
from snakesim_drivers.kit.drive_settings import BodySettings
from snakesim_gnc.control.identify import Identification, IdentifyParameters
from snakesim_hal.base.arrays import Floats
from snakesim_hal.controller import Observation
from snakesim_hal.model.robot_file.joints import Joint
from snakesim_hal.model.robot_file.robot import describe_robot
from snakesim_hal.model.scenario import RunConfig, load_scenario, parse_set_option
from snakesim_hal.wire.messages import JointMode, JointState
from snakesim_operator.features.commissioning.system_identification.identification import (
    MAX_CONSTANT_ERROR,
    JointIdentification,
    identify_joints,
)
from verification.start_check_trials import BACKLASHES_RAD, JOINT_MODULES, NONE

FILE_CONSTANT_NM_PER_A = 0.5  # torque constant of all joints in the robot file
ROBOT_OPTIONS = (
    "robot.chain.modules=5",
    "robot.motor.friction_nm=0.15",
    "robot.motor.viscous_nm_s_per_rad=0.1",
    f"robot.motor.torque_constant_nm_per_a={FILE_CONSTANT_NM_PER_A}",
)
# Fields of the robot file whose true values are hidden from the identification.
HIDDEN_FIELDS = (
    "friction_nm",
    "viscous_nm_s_per_rad",
    "armature_kg_m2",
    "response_time_s",
    "torque_constant_nm_per_a",
)
MAX_DEVIATION = 0.3  # of a hidden value from that in the file, relative
LATENCY_S = 0.01  # about which the latencies of the joints are drawn
IMU_RATE_HZ = 5.0  # of each joint module; the modules report in turn
IMU_PHASE_TICKS = 7  # between the reports of neighboring modules
GYRO_NOISE_RAD_S = 0.005
SIGNAL_NAMES = ("angle_rad", "velocity_rad_s", "torque_nm", "target")

TABLE_HEADER = (
    "| hidden fault | IMUs | robots | named | named falsely | values written | they cover | constants off "
    "| wrong constants reported | reported falsely |"
)


@dataclass(frozen=True)
class HiddenRobot:
    """A robot whose drives differ from its robot file."""

    config: RunConfig
    true_drives: Mapping[str, MountedDrive]  # by the name of the joint
    latency_s: Sequence[float]  # of each joint, tail to head
    loose_joint: int | None  # index of the joint with backlash; None without backlash


@dataclass(frozen=True)
class IdentificationTrial:
    """What was identified of one robot, compared with the true values."""

    loose_joint: int | None  # index of the joint with backlash; None without backlash
    true_drives: Mapping[str, MountedDrive]  # by the name of the joint
    joints: Sequence[JointIdentification]  # tail to head

    @property
    def named_joints(self) -> list[int]:
        """Indices of the joints that are reported to have backlash."""
        return find_joints_with_backlash(self.joints)

    @property
    def written_count(self) -> int:
        """Number of values that would be written into the robot file."""
        return len(self._compare_values())

    @property
    def covered_count(self) -> int:
        """Number of written values whose 95 % interval contains the true value."""
        return sum(value.is_covered for value in self._compare_values())

    @property
    def inaccurate_constant_count(self) -> int:
        """Number of written torque constants that differ by more than 10 % from the true ones."""
        return sum(
            value.field == "torque_constant_nm_per_a" and abs(value.relative_error) > 0.1
            for value in self._compare_values()
        )

    @property
    def wrong_constant_count(self) -> int:
        """Number of joints whose true torque constant differs by more than 10 % from that in the file."""
        return sum(self._has_wrong_constant(joint) for joint in self.joints)

    @property
    def reported_constant_count(self) -> int:
        """Number of joints with a wrong torque constant in the file that are reported."""
        return sum(
            self._has_wrong_constant(joint) and _is_constant_reported(joint)
            for joint in self.joints
        )

    @property
    def falsely_reported_constant_count(self) -> int:
        """Number of joints that are reported although the torque constant in the file is right within 10 %."""
        return sum(
            _is_constant_reported(joint) and not self._has_wrong_constant(joint)
            for joint in self.joints
        )

    def _has_wrong_constant(self, joint: JointIdentification) -> bool:
        true_nm_per_a = self.true_drives[joint.joint].torque_constant_nm_per_a
        assert true_nm_per_a is not None
        return abs(true_nm_per_a / FILE_CONSTANT_NM_PER_A - 1) > MAX_CONSTANT_ERROR

    def _compare_values(self) -> list["_WrittenValue"]:
        """Return every value that would be written into the robot file, compared with the true value."""
        values: list[_WrittenValue] = []
        for joint in self.joints:
            if joint.fails:
                continue
            for field, estimate in joint.fields.items():
                if field not in HIDDEN_FIELDS:
                    continue
                true_value = getattr(self.true_drives[joint.joint], field)
                relative_error = estimate.value / true_value - 1
                is_covered = estimate.contains(true_value)
                values.append(_WrittenValue(field, relative_error, is_covered))
        return values


@dataclass(frozen=True)
class _WrittenValue:
    """An identified value, compared with the true one."""

    field: str  # of the robot file
    relative_error: float
    is_covered: bool  # whether the 95 % interval contains the true value


def find_joints_with_backlash(joints: Sequence[JointIdentification]) -> list[int]:
    """Return the indices of the joints that the identification reports to have backlash."""
    return [
        index
        for index, joint in enumerate(joints)
        if any("backlash" in reason for reason in joint.unknown)
    ]


def _is_constant_reported(joint: JointIdentification) -> bool:
    return any("torque constant" in reason for reason in joint.wrong)


# --- a robot and its motion ---------------------------------------------------------------------------------------


def draw_hidden_robot(number: int, *options: str, backlash: bool) -> HiddenRobot:
    """Draw the hidden parameters of a robot.

    Args:
        number: Number of the robot, which is its seed.
        *options: Changes of the scenario, as `--set` of a run.
        backlash: Whether one of its joints has backlash.
    """
    pick = random.Random(number)
    texts = (*ROBOT_OPTIONS, f"seed={number + 1}", *options)
    config = load_scenario("identify", [parse_set_option(text) for text in texts]).config
    joints = config.robot.joint_table
    # Joint and backlash are drawn in any case, so that a robot has the same other values with backlash and without.
    loose_joint = pick.randrange(len(joints))
    backlash_rad = pick.choice(BACKLASHES_RAD)
    true_drives: dict[str, MountedDrive] = {}
    latency_s: list[float] = []
    for index, joint in enumerate(joints):
        values = {
            field: getattr(joint.motor, field) * pick.uniform(1 - MAX_DEVIATION, 1 + MAX_DEVIATION)
            for field in HIDDEN_FIELDS
        }
        if backlash and index == loose_joint:
            values["backlash_rad"] = backlash_rad
        true_drives[joint.name] = MountedDrive(**values)
        latency_s.append(round(LATENCY_S * pick.uniform(1 - MAX_DEVIATION, 1 + MAX_DEVIATION), 3))
    return HiddenRobot(config, true_drives, latency_s, loose_joint if backlash else None)


def record_motion(robot: HiddenRobot) -> tuple[dict[str, Floats], Floats]:
    """Move a robot with the controller of the system identification, without a bus and a host.

    Returns:
        The recorded signals by name, those of SIGNAL_NAMES, (ticks, joints) each, and the angular rates that the gyros
        of the links measured, (ticks, links, 3) in rad/s, NaN where no gyro reported.
    """
    config = robot.config
    drives = _DelayedDrives(robot)
    controller = _create_controller(config)
    tick_count = round(config.duration_s * config.rate_hz)
    rows: dict[str, list[list[float]]] = {name: [] for name in SIGNAL_NAMES}
    link_rates: list[Floats] = []
    for tick in range(tick_count):
        link_rates.append(drives.measure_link_rates(tick))
        joint_state = drives.measure_joints(tick)
        target_rad = _compute_targets(controller, config, joint_state)
        rows["angle_rad"].append(joint_state.angle_rad)
        rows["velocity_rad_s"].append(joint_state.velocity_rad_s)
        rows["torque_nm"].append(joint_state.torque_nm)
        rows["target"].append(target_rad)
        drives.send_targets(tick, target_rad)
        drives.advance(tick)
    return {name: np.array(values) for name, values in rows.items()}, np.array(link_rates)


def _create_controller(config: RunConfig) -> Identification:
    description = describe_robot(
        config.robot,
        backend="emulator",
        period_ns=config.period_ns,
        lease_ns=config.lease_ns,
        config_hash="",
    )
    parameters = msgspec.convert(config.controller_parameters, IdentifyParameters)
    return Identification(description, parameters)


def _compute_targets(
    controller: Identification, config: RunConfig, joint_state: JointState
) -> list[float]:
    """Return the targets by which the controller answers a measurement, in rad, tail to head."""
    period_s = config.period_ns * 1e-9
    time_s = joint_state.tick * period_s
    observation = Observation(joint_state.tick, time_s, period_s, joint_state, None, None)
    return list(controller.update(observation).setpoints.target)


class _DelayedDrives:
    """Emulated drives of a robot, which follow each target after the latency of their joint.

    Latencies are whole steps of the physics model.
    """

    def __init__(self, robot: HiddenRobot) -> None:
        config = robot.config
        settings = BodySettings(
            mounted=dict(robot.true_drives),
            physics_model_settings=config.backends[JOINT_MODULES]["physics_model_settings"],
        )

        # Physics.
        self._config = config
        self._file_joints = config.robot.joint_table
        self._physics_model = make_physics_model(config, settings, JOINT_MODULES)
        self._shared = SharedPhysics(config, self._physics_model, robot.true_drives, None)
        # A drive computes its torque from its current, by the torque constant in the file.
        file_nm_per_a = _list_torque_constants(self._file_joints)
        self._measured_fraction = file_nm_per_a / _list_torque_constants(self._shared.joints)

        # Time, in steps of the physics model and in ticks.
        step_s = self._physics_model.step_s
        self._steps_per_tick = round(config.period_ns * 1e-9 / step_s)
        self._latency_steps = [round(latency_s / step_s) for latency_s in robot.latency_s]
        self._ticks_per_imu_report = round(config.rate_hz / IMU_RATE_HZ)
        # Joint and target in rad, by the step in which the drive gets it.
        self._due_targets: dict[int, list[tuple[int, float]]] = defaultdict(list)

        # Sensors.
        sensor = config.robot.sensors.joints
        sigmas = [sensor.angle_noise_rad, sensor.velocity_noise_rad_s, sensor.torque_noise_nm]
        self._joint_sigma = np.array(sigmas)[:, None]
        self._draw_standard_normal = np.random.default_rng(config.seed).standard_normal

    def measure_link_rates(self, tick: int) -> Floats:
        """Return what the gyros report in a tick, (links, 3) in rad/s; NaN where a gyro does not report.

        The gyro of the tail link does not report.
        """
        joint_count = len(self._file_joints)
        rates = np.full((joint_count + 1, 3), np.nan)
        reporting_joints = [
            joint
            for joint in range(joint_count)
            if tick % self._ticks_per_imu_report
            == IMU_PHASE_TICKS * joint % self._ticks_per_imu_report
        ]
        imu = self._physics_model.imu() if reporting_joints else None
        if imu is None:
            return rates
        links = list(imu.link)
        for joint in reporting_joints:
            link = joint + 1
            true_rate = np.array(imu.angular_velocity_rad_s[links.index(link)])
            rates[link] = true_rate + GYRO_NOISE_RAD_S * self._draw_standard_normal(3)
        return rates

    def measure_joints(self, tick: int) -> JointState:
        """Return angles, velocities and torques of all joints, with noise."""
        signals = np.stack(
            (
                self._physics_model.angle_rad,
                self._physics_model.velocity_rad_s,
                self._shared.motors.torque_nm * self._measured_fraction,
            )
        )
        noisy_signals = signals + self._joint_sigma * self._draw_standard_normal(signals.shape)
        angle_rad, velocity_rad_s, torque_nm = noisy_signals.tolist()
        joint_count = len(self._file_joints)
        return JointState(
            tick=tick,
            timestamp_ns=tick * self._config.period_ns,
            angle_rad=angle_rad,
            velocity_rad_s=velocity_rad_s,
            torque_nm=torque_nm,
            valid=[True] * joint_count,
            age_ns=[0] * joint_count,
        )

    def send_targets(self, tick: int, target_rad: Sequence[float]) -> None:
        """Send a target to every drive, which gets it after its latency."""
        for joint, latency_steps in enumerate(self._latency_steps):
            step = tick * self._steps_per_tick + latency_steps
            self._due_targets[step].append((joint, target_rad[joint]))

    def advance(self, tick: int) -> None:
        """Simulate one tick, and give each drive the targets that arrive in it."""
        first_step = tick * self._steps_per_tick
        for step in range(first_step, first_step + self._steps_per_tick):
            for joint, target_rad in self._due_targets.pop(step, ()):
                self._set_target(joint, target_rad)
            self._shared.advance_to((step + 1) * self._physics_model.step_s * 1e6)

    def _set_target(self, joint: int, target_rad: float) -> None:
        """Let the motor of a joint follow a target with the gains of the robot file, in real torque."""
        motor = self._file_joints[joint].motor
        limits = self._file_joints[joint].limits
        self._shared.motors.set_demand(
            joint,
            JointMode.POSITION,
            target_rad,
            limits.torque_nm,
            motor.stiffness_nm_per_rad,
            motor.damping_nm_s_per_rad,
            limits.speed_rad_s,
        )


def _list_torque_constants(joints: Sequence[Joint]) -> Floats:
    """Return the torque constants of joints in N·m/A, (joints,); 1 for a joint without one."""
    return np.array([joint.motor.torque_constant_nm_per_a or 1.0 for joint in joints])


# --- trials and their table ---------------------------------------------------------------------------------------


def identify_hidden_robot(
    number: int, *options: str, backlash: bool
) -> tuple[IdentificationTrial, IdentificationTrial]:
    """Identify one robot twice from the same motion: with the gyros of its links, and without.

    Args:
        number: Number of the robot, which is its seed.
        *options: Changes of the scenario, as `--set` of a run.
        backlash: Whether one of its joints has backlash.
    """
    robot = draw_hidden_robot(number, *options, backlash=backlash)
    columns, link_rates = record_motion(robot)
    joints_with_imus = identify_joints(robot.config, columns, link_rates)
    joints_without_imus = identify_joints(robot.config, columns, None)
    return (
        IdentificationTrial(robot.loose_joint, robot.true_drives, joints_with_imus),
        IdentificationTrial(robot.loose_joint, robot.true_drives, joints_without_imus),
    )


def make_identification_table(first: int, trial_count: int, *options: str) -> list[str]:
    """Identify robots with backlash and without, and return the table of all trials as lines of Markdown.

    Args:
        first: Number of the first robot.
        trial_count: Number of robots. Each one is identified with backlash and without.
        *options: Changes of the scenario, as `--set` of a run.
    """
    lines = [TABLE_HEADER, "|" + "---|" * TABLE_HEADER.count(" |")]
    for backlash in (True, False):
        with_imus: list[IdentificationTrial] = []
        without_imus: list[IdentificationTrial] = []
        for number in range(first, first + trial_count):
            trial, trial_without_imus = identify_hidden_robot(number, *options, backlash=backlash)
            with_imus.append(trial)
            without_imus.append(trial_without_imus)
        fault = "backlash" if backlash else NONE
        lines.append(f"| {fault} | yes | {_format_row(with_imus, backlash=backlash)} |")
        lines.append(f"| {fault} | no | {_format_row(without_imus, backlash=backlash)} |")
    return lines


def _format_row(trials: Sequence[IdentificationTrial], *, backlash: bool) -> str:
    """Return the cells of a row of the table, from the number of robots on."""
    named = "-"
    if backlash:
        named = str(sum(trial.loose_joint in trial.named_joints for trial in trials))
    falsely_named_count = sum(
        any(joint != trial.loose_joint for joint in trial.named_joints) for trial in trials
    )
    value_count = len(HIDDEN_FIELDS) * sum(len(trial.joints) for trial in trials)
    written_count = sum(trial.written_count for trial in trials)
    covered_count = sum(trial.covered_count for trial in trials)
    covered = f"{100 * covered_count / written_count:.0f} %" if written_count else "-"
    inaccurate_count = sum(trial.inaccurate_constant_count for trial in trials)
    reported_count = sum(trial.reported_constant_count for trial in trials)
    wrong_count = sum(trial.wrong_constant_count for trial in trials)
    falsely_reported_count = sum(trial.falsely_reported_constant_count for trial in trials)
    return (
        f"{len(trials)} | {named} | {falsely_named_count} | {written_count} of {value_count} | {covered} "
        f"| {inaccurate_count} | {reported_count} of {wrong_count} | {falsely_reported_count}"
    )
