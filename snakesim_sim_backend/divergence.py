"""Detects divergence of the simulation, and keeps the last good state."""

import logging

import mujoco
import numpy as np

from snakesim_hal.base.errors import BackendError
from snakesim_sim_backend.model import FREE_DOFS
from snakesim_sim_backend.physics import Physics

_log = logging.getLogger("snakesim.sim")

MAX_POSITION = 1e4  # m or rad: of any coordinate
MAX_SPEED = 1e3  # m/s or rad/s
MAX_ACCELERATION = 1e9  # m/s² or rad/s²
BASE = ["the base along x", "the base along y", "the base along z"] + ["the base, turning,"] * 3
WHOLE = int(mujoco.mjtState.mjSTATE_INTEGRATION)  # plain numbers: the binding converts an enumeration at every call
INPUTS = int(mujoco.mjtState.mjSTATE_USER) & ~int(mujoco.mjtState.mjSTATE_USERDATA)  # the feet's is no input


def log_warnings() -> None:
    """Have MuJoCo's warnings logged; by itself it writes them into a file in the working directory."""
    mujoco.set_mju_user_warning(_log.warning)


class DivergenceWatch:
    """Checks the state once a tick, or once per other counted unit."""

    def __init__(
        self, model: mujoco.MjModel, data: mujoco.MjData, physics: Physics, steps: int, counted: str = "tick"
    ) -> None:
        """steps: from one check to the next, under the same inputs; counted: unit of a check's number."""
        self._model, self._data, self._physics = model, data, physics
        self._steps, self._counted = steps, counted
        self._good = np.empty(mujoco.mj_stateSize(model, WHOLE))
        self._qpos, self._qvel, self._qacc = data.qpos, data.qvel, data.qacc
        self._warnings = data.warning.number
        self._why: str | None = None
        self._keep()

    def check(self, number: int) -> None:
        """Keep a good state. For a bad one, restore the last good one and raise BackendError, from now on always."""
        if self._why is None:
            if self._is_good():
                self._keep()
                return
            warned = [mujoco.mjtWarning(i).name for i in self._warnings.nonzero()[0].tolist()]
            said = f" MuJoCo says {', '.join(warned)}." if warned else ""
            self._why = (
                f"the simulation diverged at {self._counted} {number}: {self._find_culprit()}.{said} Lower "
                f"`timestep_s` or the gains in [motor]; stiff gains need armature"
            )
            self._go_back()
            self._physics.forward()
        raise BackendError(self._why)

    def _is_good(self) -> bool:
        qpos, qvel, qacc, warnings = self._qpos, self._qvel, self._qacc, self._warnings
        # One comparison each, which also fails for NaN: the squared length bounds every coordinate.
        return bool(
            qpos.dot(qpos) < MAX_POSITION**2
            and qvel.dot(qvel) < MAX_SPEED**2
            and qacc.dot(qacc) < MAX_ACCELERATION**2
            and warnings.dot(warnings) == 0
        )

    def _keep(self) -> None:
        mujoco.mj_getState(self._model, self._data, self._good, WHOLE)

    def _go_back(self) -> None:
        mujoco.mj_setState(self._model, self._data, self._good, WHOLE)
        self._warnings[:] = 0

    def _find_culprit(self) -> str:
        """Where it began. A diverged state is bad everywhere; so the tick is repeated, step by step."""
        model, data = self._model, self._data
        inputs = np.empty(mujoco.mj_stateSize(model, INPUTS))
        mujoco.mj_getState(model, data, inputs, INPUTS)
        bad = self._worst() or "all values are NaN"
        self._go_back()
        mujoco.mj_setState(model, data, inputs, INPUTS)
        for _ in range(self._steps):
            self._physics.step(1)
            bad = self._worst() or bad
            if not self._is_good():
                return bad
        return "not by its own physics: its state was modified from outside"

    def _worst(self) -> str | None:
        """The greatest speed, or acceleration if that is nearer to its bound; None when they are NaN."""
        voltage_fraction, current_fraction = np.abs(self._qvel) / MAX_SPEED, np.abs(self._qacc) / MAX_ACCELERATION
        shares = np.maximum(voltage_fraction, current_fraction)
        if not np.all(np.isfinite(shares)):
            return None
        dof = int(np.argmax(shares))
        joint = self._model.joint(self._model.dof_jntid[dof])
        who = BASE[dof] if dof < FREE_DOFS else joint.name
        unit = "m" if dof < 3 or joint.type == mujoco.mjtJoint.mjJNT_SLIDE else "rad"
        return f"{who} moves at {self._qvel[dof]:.4g} {unit}/s and accelerates at {self._qacc[dof]:.4g} {unit}/s²"
