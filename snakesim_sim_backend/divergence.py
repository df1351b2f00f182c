"""Watches that the numbers stay numbers, and keeps the last state that was good."""

import mujoco
import numpy as np

from snakesim_hal.errors import BackendError
from snakesim_sim_backend.model import FREE_DOFS, FREE_QPOS

MOST_POSITION = 1e4  # m or rad: of any coordinate
MOST_SPEED = 1e3  # m/s or rad/s
MOST_ACCELERATION = 1e9  # m/s² or rad/s²
BASE = ["x", "y", "z", "roll", "pitch", "yaw"]
GRAVE = [
    mujoco.mjtWarning.mjWARN_INERTIA,
    mujoco.mjtWarning.mjWARN_CONTACTFULL,
    mujoco.mjtWarning.mjWARN_CNSTRFULL,
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
    mujoco.mjtWarning.mjWARN_BADCTRL,
]


class DivergenceWatch:
    """Checks the state once a tick."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        self._model, self._data = model, data
        self._good = np.empty(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_INTEGRATION))
        self._qpos, self._qvel, self._qacc = data.qpos, data.qvel, data.qacc
        self._warnings = data.warning.number
        self._why: str | None = None
        self.keep()

    def keep(self) -> None:
        """Remember the present state as a good one."""
        mujoco.mj_getState(self._model, self._data, self._good, mujoco.mjtState.mjSTATE_INTEGRATION)

    def check(self, tick: int) -> None:
        """Keep a good state. For a bad one, go back to the last good one and raise BackendError, from now on always."""
        if self._why is not None:
            raise BackendError(self._why)
        qpos, qvel, qacc, warnings = self._qpos, self._qvel, self._qacc, self._warnings
        # One comparison each, which NaN fails too: the squared length bounds every coordinate.
        if (
            qpos.dot(qpos) < MOST_POSITION**2
            and qvel.dot(qvel) < MOST_SPEED**2
            and qacc.dot(qacc) < MOST_ACCELERATION**2
            and warnings.dot(warnings) == 0
        ):
            self.keep()
            return
        self._why = self._explain(tick)
        data = self._data
        mujoco.mj_setState(self._model, data, self._good, mujoco.mjtState.mjSTATE_INTEGRATION)
        self._warnings[:] = 0
        mujoco.mj_forward(self._model, data)
        raise BackendError(self._why)

    def _explain(self, tick: int) -> str:
        data = self._data
        found = ""
        for what, unit, values, most in (
            ("angle", "rad", data.qpos[FREE_QPOS - FREE_DOFS :], MOST_POSITION),
            ("velocity", "rad/s", data.qvel, MOST_SPEED),
            ("acceleration", "rad/s²", data.qacc, MOST_ACCELERATION),
        ):
            size = np.nan_to_num(np.abs(values), nan=np.inf)
            worst = int(np.argmax(size))
            if size[worst] >= most / 10 and not found:
                where = f"base {BASE[worst]}" if worst < FREE_DOFS else f"joint_{worst - FREE_DOFS + 1}"
                found = f"{where} has {what} {values[worst]:g} {unit if worst >= FREE_DOFS else '(SI)'}"
        warned = [mujoco.mjtWarning(i).name for i in self._warnings.nonzero()[0]]
        said = f"; MuJoCo says {', '.join(warned)}" if warned else ""
        return (
            f"the simulation diverged at tick {tick}: {found or 'the state as a whole is too large'}{said}. "
            f"Lower `backends.sim.timestep_s` or the gains in [motor]; stiff gains want armature"
        )
