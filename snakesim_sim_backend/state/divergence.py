"""Detects divergence of the simulation, and keeps the last good state."""

import logging

import mujoco
import numpy as np

from snakesim_hal.base.errors import BackendError
from snakesim_sim_backend.model.build import FREE_DOFS
from snakesim_sim_backend.physics import PhysicsStepper

_log = logging.getLogger("snakesim.sim")

MAX_POSITION = 1e4  # m or rad: of any coordinate
MAX_SPEED = 1e3  # m/s or rad/s
MAX_ACCELERATION = 1e9  # m/s² or rad/s²
BASE_DOFS = ["the base along x", "the base along y", "the base along z"] + [
    "the base, turning,"
] * 3
# Parts of MuJoCo's state, as plain numbers: the binding would convert an enumeration at every call.
COMPLETE_STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)
# What the feet store is no input.
USER_INPUTS = int(mujoco.mjtState.mjSTATE_USER) & ~int(mujoco.mjtState.mjSTATE_USERDATA)


def log_mujoco_warnings() -> None:
    """Log MuJoCo's warnings; by default it writes them into a file in the working directory."""
    mujoco.set_mju_user_warning(_log.warning)


class DivergenceWatch:
    """Checks the state once a tick, or once per other counted unit."""

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        physics: PhysicsStepper,
        step_count: int,
        counted: str = "tick",
    ) -> None:
        """Store the current state as the last good one, to which a diverged simulation returns.

        Args:
            model: Compiled model.
            data: State of the simulation.
            physics: Physics that repeats steps to find the cause of a divergence.
            step_count: Number of physics steps from one check to the next, under the same inputs.
            counted: Unit in which checks are counted, such as "tick", for messages.
        """
        self._model = model
        self._data = data
        self._physics = physics
        self._steps_per_check = step_count
        self._check_unit = counted
        self._good_state = np.empty(mujoco.mj_stateSize(model, COMPLETE_STATE))
        self._error: str | None = None  # the message about the divergence

        # Views of MuJoCo's arrays.
        self._qpos = data.qpos
        self._qvel = data.qvel
        self._qacc = data.qacc
        self._warnings = data.warning.number
        self._store_state()

    def check(self, number: int) -> None:
        """Check the current state. A good state is stored; for a bad one the last good state is restored.

        Args:
            number: Number of the tick or step, for the message.

        Raises:
            BackendError: The state is bad, or was bad in an earlier check.
        """
        if self._error is None:
            if self._is_good():
                self._store_state()
                return
            self._error = self._describe_divergence(number)
            self._restore_state()
            self._physics.forward()
        raise BackendError(self._error, code="simulator/diverged")

    def _describe_divergence(self, number: int) -> str:
        warnings = [mujoco.mjtWarning(i).name for i in self._warnings.nonzero()[0].tolist()]
        from_mujoco = f" MuJoCo reports {', '.join(warnings)}." if warnings else ""
        return (
            f"the simulation diverged at {self._check_unit} {number}: {self._find_cause()}.{from_mujoco} Lower "
            f"`timestep_s` or the gains in [motor]; stiff gains need armature"
        )

    def _is_good(self) -> bool:
        qpos, qvel, qacc, warnings = self._qpos, self._qvel, self._qacc, self._warnings
        # The squared length bounds every coordinate, and each comparison also fails for NaN.
        return bool(
            qpos.dot(qpos) < MAX_POSITION**2
            and qvel.dot(qvel) < MAX_SPEED**2
            and qacc.dot(qacc) < MAX_ACCELERATION**2
            and warnings.dot(warnings) == 0
        )

    def _store_state(self) -> None:
        mujoco.mj_getState(self._model, self._data, self._good_state, COMPLETE_STATE)

    def _restore_state(self) -> None:
        mujoco.mj_setState(self._model, self._data, self._good_state, COMPLETE_STATE)
        self._warnings[:] = 0

    def _find_cause(self) -> str:
        """Return a text about the coordinate in which the divergence started.

        A diverged state is bad everywhere, so the steps since the last good state are repeated one by one.
        """
        model = self._model
        data = self._data
        inputs = np.empty(mujoco.mj_stateSize(model, USER_INPUTS))
        mujoco.mj_getState(model, data, inputs, USER_INPUTS)
        cause = self._describe_fastest() or "all values are NaN"
        self._restore_state()
        mujoco.mj_setState(model, data, inputs, USER_INPUTS)
        for _ in range(self._steps_per_check):
            self._physics.step(1)
            cause = self._describe_fastest() or cause
            if not self._is_good():
                return cause
        return "not by its own physics: its state was modified from outside"

    def _describe_fastest(self) -> str | None:
        """Return a text about the coordinate that is nearest to its speed or acceleration bound; None if any is NaN."""
        speed_fraction = np.abs(self._qvel) / MAX_SPEED
        acceleration_fraction = np.abs(self._qacc) / MAX_ACCELERATION
        fraction = np.maximum(speed_fraction, acceleration_fraction)
        if not np.all(np.isfinite(fraction)):
            return None
        dof = int(np.argmax(fraction))
        joint = self._model.joint(self._model.dof_jntid[dof])
        name = BASE_DOFS[dof] if dof < FREE_DOFS else joint.name
        is_linear = dof < 3 or joint.type == mujoco.mjtJoint.mjJNT_SLIDE
        unit = "m" if is_linear else "rad"
        return f"{name} moves at {self._qvel[dof]:.4g} {unit}/s and accelerates at {self._qacc[dof]:.4g} {unit}/s²"
