"""Identifies a robot with `mujoco.sysid`, which fits simulations of the whole record to the measurements.

All parameters of all joints are fitted at once, by the model of the simulator. That model has no backlash.
"""

import logging
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import msgspec
import mujoco
import mujoco.sysid as mujoco_sysid
import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.scenario import RunConfig
from snakesim_sim_backend.actuators import KD, KP
from snakesim_sim_backend.model.build import assemble_model_blueprint
from snakesim_sim_backend.physics_model import MujocoPhysicsModel
from snakesim_sim_backend.settings import PhysicsModelSettings
from verification.identification_trials import HiddenRobot
from verification.sysid.estimates import PARAMETERS, Estimate, IdentificationResult, get_truth

START_LATENCY_S = 0.01  # the robot file has no value
# The fit limits the ratio of each value to its start value.
MIN_RATIO = 0.2
MAX_RATIO = 3.0
SKIPPED_S = 0.5  # after this time, the noise of the measured start state has no effect
MAX_ITERATIONS = 15
STEP_TOLERANCE = 1e-4  # the fit ends when the ratios change less
TIME_COLUMNS = 1  # of MuJoCo's state, before positions, velocities and activations
SIGNALS = ("angle_rad", "velocity_rad_s", "torque_nm")
# `mujoco.sysid` reports residuals without a verdict. Above this rms, in standard deviations of the noise, a careful
# user would not trust the fit. With an exact model, the rms is 1.0; one of six fits stopped at 1.05.
MAX_NOISE_RATIO = 1.1


@dataclass(frozen=True)
class FitResult:
    """The values that `mujoco.sysid` has fitted, by the names that `make_parameter_name` returns."""

    values: Mapping[str, float]
    half_widths: Mapping[str, float]  # of the 95 % intervals
    noise_ratios: Floats  # (joints,) rms of the residuals, in standard deviations of the noise


def make_spec(config: RunConfig) -> mujoco.MjSpec:
    """Return the simulator's model of the hanging robot with its motors, without parts that only slow it down.

    Ground, contacts and sensors have no effect on a robot that hangs.
    """
    table = config.backends["can"]["physics_model_settings"]
    settings = msgspec.convert(table, PhysicsModelSettings)
    spec = assemble_model_blueprint(config, settings, motors=True, laws="python").spec
    for sensor in list(spec.sensors):
        spec.delete(sensor)
    for geom in spec.geoms:
        geom.contype = 0
        geom.conaffinity = 0
    for motor in spec.actuators:  # mujoco.sysid 4.0.1 fails for motors with more than one input
        motor.ctrlspec = int(mujoco.mjtCtrlInput.mjINPUT_POS)
    return spec


def get_start_value(config: RunConfig, joint_index: int, parameter: str) -> float:
    """Return the value with which the fit begins: that of the robot file."""
    if parameter == "latency_s":
        return START_LATENCY_S
    return getattr(config.robot.joint_table[joint_index].motor, parameter)


class RolloutFit:
    """The fit of all parameters of a robot by `mujoco.sysid`: each is a ratio to its start value."""

    def __init__(self, robot: HiddenRobot, columns: Mapping[str, Floats]) -> None:
        """Prepare the fit.

        Args:
            robot: The robot. Its hidden parameters are not used here.
            columns: The record of its motion, by signal.
        """
        self._config = robot.config
        self._joint_count = len(robot.config.robot.joint_table)
        self._columns = columns
        self.spec = make_spec(robot.config)
        self.model = self.spec.compile()
        self._step_s = float(self.model.opt.timestep)
        period_s = robot.config.period_ns * 1e-9
        self._steps_per_tick = round(period_s / self._step_s)
        tick_count = len(columns["target"])
        # One input more than steps: mujoco.sysid does not simulate the last one.
        self._held_target_rad = np.repeat(columns["target"], self._steps_per_tick, axis=0)
        self._control_times_s = np.arange(len(self._held_target_rad)) * self._step_s
        first_tick = round(SKIPPED_S / period_s)
        self._ticks = np.arange(first_tick, tick_count - 1)
        self._measured = np.column_stack([columns[name] for name in SIGNALS])[self._ticks]
        sensor = robot.config.robot.sensors.joints
        self._noise = np.repeat(
            [sensor.angle_noise_rad, sensor.velocity_noise_rad_s, sensor.torque_noise_nm],
            self._joint_count,
        )

    def run(self) -> FitResult:
        """Fit all parameters, beginning with those of the robot file."""
        parameters = mujoco_sysid.ParameterDict()
        start_values: dict[str, float] = {}
        for i in range(self._joint_count):
            for parameter in PARAMETERS:
                name = make_parameter_name(i, parameter)
                start_values[name] = get_start_value(self._config, i, parameter)
                parameters.add(mujoco_sysid.Parameter(name, 1.0, MIN_RATIO, MAX_RATIO))
        residual = mujoco_sysid.build_residual_fn(
            models_sequences=[self._make_sequences()],
            build_model=self._build_model,
            custom_rollout=self._roll_out,
            modify_residual=self._compute_residual,
            resample_true=False,
            n_threads=1,
        )
        fitted, result = mujoco_sysid.optimize(
            parameters,
            residual,
            verbose=False,  # of the summary; the optimizer itself prints its iterations
            max_iters=MAX_ITERATIONS,
            xtol=STEP_TOLERANCE,
        )
        residuals, _, _ = residual(result.x, fitted)
        _, half_widths = mujoco_sysid.calculate_intervals(residuals, result.jac)
        by_joint = np.concatenate(residuals).reshape(-1, len(SIGNALS), self._joint_count)
        return FitResult(
            values={name: start_values[name] * fitted[name].value[0] for name in start_values},
            half_widths={
                name: start_values[name] * float(width)
                for name, width in zip(start_values, half_widths, strict=True)
            },
            noise_ratios=np.sqrt(np.mean(by_joint**2, axis=(0, 1))),
        )

    def _make_sequences(self) -> Any:
        """Return the record in the types of `mujoco.sysid`."""
        data = mujoco.MjData(self.model)
        hanging = MujocoPhysicsModel(self._config, PhysicsModelSettings(suspended=True))
        data.qpos[:] = hanging.data.qpos
        data.qpos[-self._joint_count :] = self._columns["angle_rad"][0]
        control = np.zeros((len(self._control_times_s), self.model.nu))
        return mujoco_sysid.ModelSequences(
            "hanging robot",
            self.spec,
            "record",
            mujoco_sysid.create_initial_state(self.model, data.qpos, data.qvel, data.act),
            mujoco_sysid.TimeSeries(self._control_times_s, control),
            self._make_series(self._measured),
            allow_missing_sensors=True,
        )

    def _make_series(self, values: Floats) -> Any:
        times_s = self._ticks * self._steps_per_tick * self._step_s
        signals = [f"signal_{i}" for i in range(values.shape[1])]
        return mujoco_sysid.TimeSeries.from_custom_map(times_s, values, signals)

    def _get_value(self, parameters: Any, joint_index: int, parameter: str) -> float:
        ratio = float(parameters[make_parameter_name(joint_index, parameter)].value[0])
        return ratio * get_start_value(self._config, joint_index, parameter)

    def _build_model(self, parameters: Any, spec: mujoco.MjSpec) -> mujoco.MjModel:
        """Compile the model with some parameters."""
        for i, joint in enumerate(self._config.robot.joint_table):
            hinge = spec.joint(joint.name)
            hinge.armature = self._get_value(parameters, i, "armature_kg_m2")
            hinge.damping[0] = self._get_value(parameters, i, "viscous_nm_s_per_rad")
            hinge.frictionloss = self._get_value(parameters, i, "friction_nm")
            motor = spec.actuator(f"motor_{joint.name}")
            motor.dynprm[0] = self._get_value(parameters, i, "response_time_s")
            motor.gainprm[KP] = self._get_value(parameters, i, "stiffness_nm_per_rad")
            motor.gainprm[KD] = self._get_value(parameters, i, "damping_nm_s_per_rad")
        return spec.compile()

    def _roll_out(self, *, control_signal: Any, param_dicts: Any, **others: Any) -> Any:
        """Simulate the record with each set of parameters, and delay the targets by its latencies."""
        del control_signal
        controls = [
            mujoco_sysid.TimeSeries(self._control_times_s, self._delay_targets(parameters))
            for parameters in param_dicts
        ]
        return mujoco_sysid.sysid_rollout(control_signal=controls, **others)

    def _delay_targets(self, parameters: Any) -> Floats:
        """Return the inputs of the motors, (steps, inputs). Parts of a step are interpolated."""
        control = np.zeros((len(self._control_times_s), self.model.nu))
        for i in range(self._joint_count):
            latency_s = self._get_value(parameters, i, "latency_s")
            whole_steps, part = divmod(latency_s / self._step_s, 1.0)
            steps = np.arange(len(control)) - int(whole_steps)
            target_rad = self._held_target_rad[:, i]
            start_rad = self._columns["angle_rad"][0, i]
            newer = np.where(steps >= 0, target_rad[np.maximum(steps, 0)], start_rad)
            older = np.where(steps >= 1, target_rad[np.maximum(steps - 1, 0)], start_rad)
            control[:, i] = (1 - part) * newer + part * older
        return control

    def _compute_residual(
        self,
        parameters: Any,
        _predicted: Any,
        measured: Any,
        model: mujoco.MjModel,
        _return_all: bool,
        *,
        state: Floats,
        **_others: Any,
    ) -> tuple[Floats, Any, Any]:
        """Return measured minus simulated signals in standard deviations of their noise, (ticks, signals)."""
        rows = state[self._ticks * self._steps_per_tick - 1]  # after the step that ends at the tick
        speed_end = TIME_COLUMNS + model.nq + model.nv
        angle_rad = rows[:, TIME_COLUMNS + model.nq - self._joint_count : TIME_COLUMNS + model.nq]
        velocity_rad_s = rows[:, speed_end - self._joint_count : speed_end]
        torque_nm = rows[:, speed_end : speed_end + self._joint_count]
        # A drive computes its torque from its current with the constant in the robot file.
        constants = [
            parameters[make_parameter_name(i, "torque_constant_nm_per_a")].value[0]
            for i in range(self._joint_count)
        ]
        predicted = np.column_stack((angle_rad, velocity_rad_s, torque_nm / constants))
        residual = (measured.data - predicted) / self._noise
        return residual, self._make_series(predicted), measured


def make_parameter_name(joint_index: int, parameter: str) -> str:
    """Return the name of a parameter of a joint in `mujoco.sysid`."""
    return f"{parameter} of joint {joint_index + 1}"


def identify_by_rollouts(robot: HiddenRobot, columns: Mapping[str, Floats]) -> IdentificationResult:
    """Identify a robot with `mujoco.sysid`, from the record of its motion."""
    logging.getLogger("absl").setLevel(logging.ERROR)
    start_s = time.process_time()
    fit = RolloutFit(robot, columns).run()
    cpu_s = time.process_time() - start_s
    estimates: list[Estimate] = []
    for i in range(len(robot.config.robot.joint_table)):
        for parameter in PARAMETERS:
            name = make_parameter_name(i, parameter)
            truth = get_truth(robot, i, parameter)
            estimates.append(Estimate(i, parameter, fit.values[name], fit.half_widths[name], truth))
    noise_ratio = float(np.sqrt(np.mean(fit.noise_ratios**2)))
    warns = noise_ratio > MAX_NOISE_RATIO
    return IdentificationResult(
        estimates,
        cpu_s,
        warns=warns,
        suspect=int(np.argmax(fit.noise_ratios)) if warns else None,
        noise_ratio=noise_ratio,
    )


def has_mujoco_sysid() -> bool:
    """Return whether `mujoco.sysid` can be used: it is empty if one of its optional packages is missing."""
    return hasattr(mujoco_sysid, "optimize")
