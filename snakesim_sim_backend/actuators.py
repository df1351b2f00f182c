"""Drives the motors: four modes in one native MuJoCo actuator, so that no Python runs between physics steps.

Each joint has a `dcmotor` with motor constant 1, so that its current is its torque. At every physics step

    demand = kp (position - angle) + kd (velocity - speed) + feed-forward       the mode chooses the gains
    demand is limited by the line that falls from the roll-off times full torque at rest to 0 at the speed limit
    torque follows the demand as a first-order lag of `response_time_s`, integrated exactly
    torque is clipped to the command's limit and the joint's derated one

The torque is the motor's state; a change of mode changes only the demand. So torque never jumps on a change of mode:
it follows the new demand with the motor's response time, also to zero in passive mode.

A motor with a latency follows the targets of that time ago, which MuJoCo keeps as the history of its inputs. A change
of mode is not delayed: the history then starts anew with the target of the new mode.
"""

import math
from typing import Protocol

import mujoco
import numpy as np

from snakesim_hal.backend import SafeSetpoints
from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import BackendError
from snakesim_hal.model.robot_file.joints import Joint
from snakesim_hal.model.robot_file.robot import ModuleBody, RobotFile
from snakesim_hal.physics.motor import compute_torque_roll_off
from snakesim_hal.wire.messages import JointMode

# Indices of a dcmotor's parameters in actuator_gainprm; checked against the compiled model in `ModelMotors`.
KP = 4
KD = 6
MAX_VOLTS = 7
# Inputs of a motor in `ctrl`: position, velocity, feed-forward torque.
INPUTS_PER_MOTOR = 3
TORQUE_INPUT = 2
INPUT_INDEX_BY_MODE = {
    JointMode.PASSIVE: TORQUE_INPUT,
    JointMode.POSITION: 0,
    JointMode.VELOCITY: 1,
    JointMode.TORQUE: TORQUE_INPUT,
}


def add_motor(spec: mujoco.MjSpec, joint: Joint, module: ModuleBody, step_s: float) -> None:
    """Add the motor of one joint to a model. The motor starts in passive mode."""
    limits = joint.limits
    # With motor constant 1, volts are rad/s, and the torque at rest under full volts is speed limit / resistance.
    stall_torque_nm = compute_torque_roll_off(joint, module, step_s) * limits.torque_nm
    inputs = mujoco.mjtCtrlInput
    motor = spec.add_actuator(
        name=f"motor_{joint.name}", target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT
    )
    motor.set_to_dcmotor(
        motorconst=[1.0, 0.0],
        resistance=limits.speed_rad_s / stall_torque_nm,
        inductance=[0.0, joint.motor.response_time_s],
        controller=[1.0, 0.0, 1.0, 0.0, 0.0, limits.speed_rad_s],
        saturation=[limits.torque_nm, 0.0, 0.0],
        ctrlspec=int(inputs.mjINPUT_POS | inputs.mjINPUT_VEL | inputs.mjINPUT_FF),
    )
    if joint.motor.latency_s > 0:
        motor.delay = joint.motor.latency_s
        # One sample for each physics step, and the newest.
        motor.nsample = math.ceil(joint.motor.latency_s / step_s) + 1


def _make_gains_by_mode(joint: Joint, scale: float) -> dict[JointMode, tuple[float, float, float]]:
    """Return kp, kd and maximum volts of each mode that the joint's drive has. 0 V means no limit.

    Args:
        joint: Joint with its motor and drive.
        scale: Factor on kp and kd.
    """
    motor = joint.motor
    max_volts = joint.limits.speed_rad_s
    gains = {
        JointMode.PASSIVE: (0.0, 0.0, 0.0),
        JointMode.POSITION: (
            scale * motor.stiffness_nm_per_rad,
            scale * motor.damping_nm_s_per_rad,
            max_volts,
        ),
        JointMode.VELOCITY: (0.0, scale * motor.velocity_gain_nm_s_per_rad, max_volts),
        JointMode.TORQUE: (0.0, 0.0, max_volts),
    }
    mode_names = ("passive", *joint.drive.modes)
    return {mode: values for mode, values in gains.items() if mode.name.lower() in mode_names}


class MotorData(Protocol):
    """The arrays of MuJoCo's state that motors read and write."""

    @property
    def act(self) -> Floats: ...
    @property
    def actuator_force(self) -> Floats: ...
    @property
    def ctrl(self) -> Floats: ...
    @property
    def history(self) -> Floats: ...


class _InputHistory:
    """The latest inputs of one motor with a latency, in MuJoCo's `history`.

    Its numbers are one of the user, the index of the newest sample, the times of all samples, and their inputs.
    """

    HEADER_NUMBERS = 2

    def __init__(self, model: mujoco.MjModel, motor_index: int) -> None:
        """Find the history of a motor in a compiled model."""
        self._motor = motor_index
        self._sample_count = int(model.actuator_history[motor_index, 0])
        self._step_s = float(model.opt.timestep)
        self._start = int(model.actuator_historyadr[motor_index])

    def forget(self, history: Floats, inputs: Floats) -> None:
        """Let the present inputs of a motor be those of all samples, so that they count at once."""
        first = self._start + self.HEADER_NUMBERS + self._sample_count
        samples = history[first : first + INPUTS_PER_MOTOR * self._sample_count].reshape(
            -1, INPUTS_PER_MOTOR
        )
        samples[:] = inputs[INPUTS_PER_MOTOR * self._motor : INPUTS_PER_MOTOR * (self._motor + 1)]

    def restart_at_time_0(self, history: Floats) -> None:
        """Let the samples be those of the steps before time 0, as at the start of a simulation."""
        history[self._start + 1] = self._sample_count - 1
        first = self._start + self.HEADER_NUMBERS
        history[first : first + self._sample_count] = self._step_s * np.arange(
            -self._sample_count, 0
        )


class ModelMotors:
    """All motors of a compiled model, tail to head.

    Attributes:
        count: Number of motors.
        joints_without_torque_sensor: Joints whose drives do not measure their torque.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        data: MotorData,
        robot: RobotFile,
        period_s: float,
        gain_scale: float = 1.0,
    ) -> None:
        """Take control of the motors of a compiled model, and switch them off.

        The inputs, limits and gains are views of MuJoCo's arrays, so that a tick copies nothing.

        Args:
            model: Compiled model.
            data: State of the simulation.
            robot: Robot file, with the limits, gains and response times of all joints.
            period_s: Duration of a control period in s.
            gain_scale: Factor on the gains of the robot file.
        """
        joints = robot.joint_table
        self.count = len(joints)
        self.joints_without_torque_sensor = [
            i for i, joint in enumerate(joints) if "torque" not in joint.drive.measures
        ]
        self._names = [joint.name for joint in joints]
        self._gains_by_mode = [_make_gains_by_mode(joint, gain_scale) for joint in joints]
        self._input_histories = [
            _InputHistory(model, i) for i, joint in enumerate(joints) if joint.motor.latency_s > 0
        ]

        # Views of MuJoCo's arrays.
        self._gains = model.actuator_gainprm[: self.count]
        self._min_torque_nm = model.actuator_forcerange[: self.count, 0]
        self._max_torque_nm = model.actuator_forcerange[: self.count, 1]
        self.bind_state(data)

        # Torque limits, (n_joints,) each: of the robot file, after derating, and the minimum of that and the command's.
        self._full_limit_nm = np.array([joint.limits.torque_nm for joint in joints])
        self._derated_limit_nm = self._full_limit_nm
        self._limit_nm = self._full_limit_nm.copy()
        self._commanded_limit_nm: list[float] = self._limit_nm.tolist()
        self._limit_is_changing = False
        self._torque_decay = np.array(
            [_compute_torque_decay(period_s, joint.motor.response_time_s) for joint in joints]
        )

        # Current modes, and the indices of their inputs in `ctrl`.
        self._modes: list[JointMode] = []
        self._input_indices = np.empty(0, dtype=np.intp)
        self._passive_indices: list[int] = []
        # The gains of `add_motor` must be where the indices of this module say.
        expected_gains = [[1.0, 1.0, joint.limits.speed_rad_s] for joint in joints]
        assert np.all(self._gains[:, [KP, KD, MAX_VOLTS]] == expected_gains)
        self.switch_off()

    def bind_state(self, data: MotorData) -> None:
        """Read and write the arrays of this state from now on."""
        self._torque_state = data.act  # empty when the motors have no lag
        self._applied_nm = data.actuator_force[: self.count]
        self._inputs = data.ctrl[: INPUTS_PER_MOTOR * self.count]
        self._history = data.history

    def enact(self, setpoints: SafeSetpoints) -> None:
        """Apply setpoints, tail to head; they hold until the next call.

        Raises:
            BackendError: A drive does not have the mode of its setpoint.
        """
        self.set_inputs(setpoints.mode, setpoints.target, setpoints.torque_limit_nm)

    def set_inputs(
        self, modes: list[JointMode], targets: list[float], limits_nm: list[float]
    ) -> None:
        """Drive the simulated motors, as `enact` does; also before a run begins, when no limiter is there yet."""
        has_new_modes = modes != self._modes
        if has_new_modes:
            self._change_modes(modes)
        self._inputs[self._input_indices] = targets
        if self._passive_indices:
            self._inputs[self._passive_indices] = 0.0
        if has_new_modes:
            for input_history in self._input_histories:
                input_history.forget(self._history, self._inputs)
        if limits_nm != self._commanded_limit_nm:
            self._commanded_limit_nm = list(limits_nm)
            self._update_limit()

    def derate(self, remaining_fraction: Floats) -> None:
        """Derate each joint's own limit to this fraction, (n_joints,), whatever a command allows."""
        self._derated_limit_nm = self._full_limit_nm * remaining_fraction
        self._update_limit()

    def switch_off(self) -> None:
        """Make all joints passive."""
        zeros = [0.0] * self.count
        self.set_inputs([JointMode.PASSIVE] * self.count, zeros, self._full_limit_nm.tolist())

    def restart_at_time_0(self) -> None:
        """Forget the targets of the time before the simulation is set to time 0, for motors with a latency."""
        for input_history in self._input_histories:
            input_history.restart_at_time_0(self._history)
            input_history.forget(self._history, self._inputs)

    def apply_pending_torque_limits(self) -> None:
        """Lower the torque limits as fast as the motors can follow, and end wind-up above them.

        Call this once in each tick, before the physics steps.
        """
        if len(self._torque_state) == 0:
            if self._limit_is_changing:
                self._set_range(self._limit_nm)
                self._limit_is_changing = False
            return
        if self._limit_is_changing:
            remaining_nm = np.abs(self._applied_nm) * self._torque_decay
            self._limit_is_changing = bool(np.any(remaining_nm > self._limit_nm))
            self._set_range(np.maximum(self._limit_nm, remaining_nm))
        np.minimum(self._torque_state, self._max_torque_nm, out=self._torque_state)
        np.maximum(self._torque_state, self._min_torque_nm, out=self._torque_state)

    def get_applied_torque_nm(self) -> Floats:
        """Return a view of the torque of every motor over the last physics step, (n_joints,) float64."""
        return self._applied_nm

    @property
    def is_limit_changing(self) -> bool:
        """Whether the torque limits have not reached their new values yet."""
        return self._limit_is_changing

    @property
    def torque_range_nm(self) -> tuple[Floats, Floats]:
        """Views of the current minimum and maximum torque of every motor, (n_joints,) each."""
        return self._min_torque_nm, self._max_torque_nm

    def _update_limit(self) -> None:
        self._limit_nm = np.minimum(self._commanded_limit_nm, self._derated_limit_nm)
        self._limit_is_changing = True

    def _set_range(self, limit_nm: Floats) -> None:
        self._max_torque_nm[:] = limit_nm
        self._min_torque_nm[:] = -limit_nm

    def _change_modes(self, modes: list[JointMode]) -> None:
        """Set the gains of new modes, and find their inputs.

        Raises:
            BackendError: A drive does not have a mode.
        """
        for gains, mode, name in zip(self._gains_by_mode, modes, self._names, strict=True):
            if mode not in gains:
                raise BackendError(
                    f"{name} got a setpoint in {mode.name.lower()} mode, which its drive does not have"
                )
        self._modes = list(modes)
        self._gains[:, [KP, KD, MAX_VOLTS]] = [
            gains[mode] for gains, mode in zip(self._gains_by_mode, modes, strict=True)
        ]
        indices = [INPUTS_PER_MOTOR * i + INPUT_INDEX_BY_MODE[mode] for i, mode in enumerate(modes)]
        self._input_indices = np.array(indices, dtype=np.intp)
        self._passive_indices = [
            INPUTS_PER_MOTOR * i + TORQUE_INPUT
            for i, mode in enumerate(modes)
            if mode == JointMode.PASSIVE
        ]
        self._inputs[:] = 0.0


def _compute_torque_decay(period_s: float, response_time_s: float) -> float:
    """Return the fraction of its torque that a motor without demand still has after a control period."""
    if response_time_s > 0:
        return math.exp(-period_s / response_time_s)
    return 0.0
