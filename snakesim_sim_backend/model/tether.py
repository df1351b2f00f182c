"""The rope of the static checks and of towing: a tendon from a point of the snake to an anchor far away.

A tendon with a limited length keeps the point on a circle of radius `ROPE_LENGTH_M` around the anchor. Over 0.1 m to
the side the circle deviates from a straight line by 0.1 mm.
"""

import mujoco
import numpy as np

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_sim_backend.settings import TetherSettings

ROPE_LENGTH_M = 50.0  # long enough for the accuracy above
SLACK_LENGTH_M = 1e4  # longest rope of a tether that is not tightened yet
WINCH_N_S_PER_M = 300.0  # force for each m/s by which the winch is too slow
MAX_WINCH_FORCE_N = 1000.0
HOOK_SITE = "tether_hook"  # names in MuJoCo's model: site on the snake
ANCHOR = "tether_anchor"  # site in the world
TENDON = "tether"
WINCH = "tether_winch"
LIMIT_FORCE = int(mujoco.mjtConstraint.mjCNSTR_LIMIT_TENDON)


def add_tether(
    spec: mujoco.MjSpec, tether: TetherSettings, robot: RobotFile, contact_time_s: float
) -> None:
    """Add a slack tether between the world and a link to a model whose motors are complete.

    The tether is a tendon with a maximum length. If it is reeled in, a winch shortens it with a limited force.

    Args:
        spec: Model, which is changed.
        tether: Settings of the tether: link, point on the link, direction, and speed of the winch.
        robot: Robot file, for the number of links.
        contact_time_s: Time constant in s of the limit of the tether's length.

    Raises:
        ConfigError: The robot has no such link, or the tether has no direction.
    """
    if tether.link > robot.chain.modules:
        raise ConfigError(
            f"`tether.link` = {tether.link}: robot {robot.name!r} has links 0 to {robot.chain.modules}",
            code="config/out-of-range",
        )
    if np.hypot(*tether.direction_w) == 0:
        raise ConfigError(
            "`tether.direction_w` = (0, 0) is not a direction; give x and y, such as [-1, 0]"
        )
    spec.body(f"link_{tether.link}").add_site(name=HOOK_SITE, pos=[tether.point_m, 0.0, 0.0])
    # At the origin MuJoCo would not let it be moved.
    spec.worldbody.add_site(name=ANCHOR, pos=[ROPE_LENGTH_M, 0.0, 0.0])
    tendon = spec.add_tendon(
        name=TENDON,
        limited=True,
        range=[0.0, SLACK_LENGTH_M],
        solref_limit=[contact_time_s, 1.0],
        solimp_limit=[0.99, 0.999, 0.001, 0.5, 2.0],
    )
    tendon.wrap_site(ANCHOR)
    tendon.wrap_site(HOOK_SITE)
    if tether.reel_in_m_s > 0:
        spec.add_actuator(
            name=WINCH,
            target=TENDON,
            trntype=mujoco.mjtTrn.mjTRN_TENDON,
            gainprm=[WINCH_N_S_PER_M] + [0.0] * 9,
            biastype=mujoco.mjtBias.mjBIAS_AFFINE,
            biasprm=[0.0, 0.0, -WINCH_N_S_PER_M] + [0.0] * 7,
            forcelimited=True,
            forcerange=[-MAX_WINCH_FORCE_N, 0.0],  # it shortens the rope, and never pushes it
        )


class TetherRope:
    """The tether of a compiled model."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, tether: TetherSettings) -> None:
        self._model = model
        self._data = data
        self._tether = tether
        self._winch: int | None = None
        if tether.reel_in_m_s > 0:
            self._winch = model.actuator(WINCH).id

    def tighten(self) -> None:
        """Place the anchor for the snake's present position, and take up the slack."""
        model = self._model
        data = self._data
        mujoco.mj_kinematics(model, data)
        direction_w = np.array([*self._tether.direction_w, 0.0])
        hook_w = data.site(HOOK_SITE).xpos
        model.site_pos[model.site(ANCHOR).id] = (
            hook_w + ROPE_LENGTH_M * direction_w / np.linalg.norm(direction_w)
        )
        model.tendon_range[model.tendon(TENDON).id] = [0.0, ROPE_LENGTH_M]
        if self._winch is not None:
            data.ctrl[model.actuator_ctrladr[self._winch]] = -self._tether.reel_in_m_s

    def measure_tension_n(self) -> float:
        """Return the force in the rope over the last physics step."""
        data = self._data
        limit_force_n = data.efc_force[data.efc_type == LIMIT_FORCE].sum()
        winch_force_n = 0.0
        if self._winch is not None:
            winch_force_n = -data.actuator_force[self._winch]
        return float(limit_force_n + winch_force_n)
