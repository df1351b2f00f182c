"""The motors: four modes in one native MuJoCo actuator, so that no Python runs between physics steps.

Each joint has a `dcmotor` with motor constant 1, so that its current is its torque. At every physics step

    demand = kp (position - angle) + kd (velocity - speed) + feed-forward       the mode chooses the gains
    demand is limited by the line that falls from `roll_off` times full torque at rest to 0 at the speed limit
    torque follows the demand as a first-order lag of `response_time_s`, integrated exactly
    torque is clipped to the command's limit and the joint's derated one

The torque is the motor's state; a change of mode changes only the demand. So torque never jumps on a change of mode:
it follows the new demand with the motor's response time, also to zero in passive mode.
"""

import math

import mujoco
import numpy as np

from snakesim_hal.backend import SafeSetpoints
from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import BackendError
from snakesim_hal.model.joints import Joint
from snakesim_hal.model.robot import Module, RobotFile
from snakesim_hal.physics.motor import roll_off
from snakesim_hal.wire.messages import Mode

# Indices of a dcmotor's parameters in actuator_gainprm; checked against the compiled model in `Motors`.
KP, KD, MAX_VOLTS = 4, 6, 7
INPUTS = 3  # position, velocity, feed-forward torque
INPUT_OF_MODE = {Mode.PASSIVE: 2, Mode.POSITION: 0, Mode.VELOCITY: 1, Mode.TORQUE: 2}


def add_motor(spec: mujoco.MjSpec, joint: Joint, module: Module, step_s: float) -> None:
    """Add the motor of one joint to a model; it starts passive."""
    limits = joint.limits
    motor = spec.add_actuator(name=f"motor_{joint.name}", target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    inputs = mujoco.mjtCtrlInput
    motor.set_to_dcmotor(
        motorconst=[1.0, 0.0],
        # With constant 1, volts are rad/s, and torque at rest under full volts is limits.speed / resistance.
        resistance=limits.speed_rad_s / (roll_off(joint, module, step_s) * limits.torque_nm),
        inductance=[0.0, joint.motor.response_time_s],
        controller=[1.0, 0.0, 1.0, 0.0, 0.0, limits.speed_rad_s],
        saturation=[limits.torque_nm, 0.0, 0.0],
        ctrlspec=int(inputs.mjINPUT_POS | inputs.mjINPUT_VEL | inputs.mjINPUT_FF),
    )


def _gains(joint: Joint, scale: float) -> dict[Mode, tuple[float, float, float]]:
    """Mode -> kp, kd and volts (0: unbounded)."""
    motor, speed = joint.motor, joint.limits.speed_rad_s
    gains = {
        Mode.PASSIVE: (0.0, 0.0, 0.0),
        Mode.POSITION: (scale * motor.stiffness_nm_per_rad, scale * motor.damping_nm_s_per_rad, speed),
        Mode.VELOCITY: (0.0, scale * motor.velocity_gain_nm_s_per_rad, speed),
        Mode.TORQUE: (0.0, 0.0, speed),
    }
    has = ("passive", *joint.drive.modes)
    return {mode: values for mode, values in gains.items() if mode.name.lower() in has}


class Motors:
    """All motors of a compiled model."""

    def __init__(
        self, model: mujoco.MjModel, data: mujoco.MjData, robot: RobotFile, period_s: float, gain_scale: float = 1.0
    ) -> None:
        joints = robot.joint_table
        self.count, self._names = len(joints), [joint.name for joint in joints]
        self.without_torque = [i for i, joint in enumerate(joints) if "torque" not in joint.drive.measures]
        self._gains = model.actuator_gainprm[: self.count]
        self._force_range = model.actuator_forcerange[: self.count]
        self._least, self._most = self._force_range[:, 0], self._force_range[:, 1]
        self._torque = data.act  # empty when the motors have no lag
        self._applied = data.actuator_force[: self.count]
        self._inputs = data.ctrl[: INPUTS * self.count]
        self._full_limit = np.array([joint.limits.torque_nm for joint in joints])
        self._own_limit = self._full_limit  # after derating
        self._limit = self._full_limit.copy()
        self._limit_asked: list[float] = self._limit.tolist()
        self._fading = False
        lags_s = [joint.motor.response_time_s for joint in joints]
        self._decay = np.array([math.exp(-period_s / lag_s) if lag_s > 0 else 0.0 for lag_s in lags_s])
        self._gains_of_mode = [_gains(joint, gain_scale) for joint in joints]
        assert np.all(self._gains[:, [KP, KD, MAX_VOLTS]] == [[1.0, 1.0, joint.limits.speed_rad_s] for joint in joints])
        self._mode: list[Mode] = []
        self._slots = np.empty(0, dtype=np.intp)
        self.switch_off()

    def enact(self, setpoints: SafeSetpoints) -> None:
        """Take setpoints, tail to head; they hold until the next call."""
        if setpoints.mode != self._mode:
            self._change_modes(setpoints.mode)
        self._inputs[self._slots] = setpoints.target
        if self._passive:
            self._inputs[self._passive] = 0.0
        if setpoints.torque_limit_nm != self._limit_asked:
            self._limit_asked = list(setpoints.torque_limit_nm)
            self._bound()

    def derate(self, remaining_fraction: Floats) -> None:
        """Derate each joint's own limit to this share, (n_joints,), whatever a command allows."""
        self._own_limit = self._full_limit * remaining_fraction
        self._bound()

    def switch_off(self) -> None:
        """All joints passive."""
        zeros = [0.0] * self.count
        self.enact(SafeSetpoints([Mode.PASSIVE] * self.count, zeros, self._full_limit.tolist()))

    def before_steps(self) -> None:
        """Once a tick: apply a lowered limit as fast as the motor can follow, and end wind-up above it."""
        if len(self._torque) == 0:
            if self._fading:
                self._set_range(self._limit)
                self._fading = False
            return
        if self._fading:
            left = np.abs(self._applied) * self._decay
            self._fading = bool(np.any(left > self._limit))
            self._set_range(np.maximum(self._limit, left))
        np.minimum(self._torque, self._most, out=self._torque)
        np.maximum(self._torque, self._least, out=self._torque)

    def applied_nm(self) -> Floats:
        """Torque of every motor over the last physics step, (n_joints,) float64."""
        return self._applied

    def _bound(self) -> None:
        self._limit = np.minimum(self._limit_asked, self._own_limit)
        self._fading = True

    def _set_range(self, limit_nm: Floats) -> None:
        self._most[:] = limit_nm
        self._least[:] = -limit_nm

    def _change_modes(self, modes: list[Mode]) -> None:
        for gains, mode, name in zip(self._gains_of_mode, modes, self._names, strict=True):
            if mode not in gains:
                raise BackendError(f"{name} was given a setpoint in {mode.name.lower()} mode, which its drive lacks")
        self._mode = list(modes)
        self._gains[:, [KP, KD, MAX_VOLTS]] = [
            gains[mode] for gains, mode in zip(self._gains_of_mode, modes, strict=True)
        ]
        self._slots = np.array([INPUTS * i + INPUT_OF_MODE[mode] for i, mode in enumerate(modes)], dtype=np.intp)
        self._passive = [INPUTS * i + 2 for i, mode in enumerate(modes) if mode == Mode.PASSIVE]
        self._inputs[:] = 0.0
