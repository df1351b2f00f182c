"""Baselines that use no map: waves that travel along the body, whatever stands around it.

Lateral undulation is the serpenoid curve: every joint swings by `amplitude_rad`, a phase `lag_rad` behind the one ahead
of it. Head-steered undulation adds a bend to all joints in proportion to the direction of the path, seen from the head.
Compliant undulation lets obstacles change the amplitude of the wave: body-shape compliance (Travers et al. 2018). It
may resolve jams: where the body stands, the wave travels the other way for a while.
"""

import math
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.control.bumpless import Blend, BumplessReference
from snakesim_gnc.control.controller import Action, Report, View, motion_wanted
from snakesim_gnc.control.standstill import Standstill
from snakesim_gnc.geometry.planar_body import PlanarBody
from snakesim_hal.model.files import FileStruct
from snakesim_hal.wire.messages import Description
from snakesim_hal.wire.quantities import about, above, bounded, from_zero

AIM_M = 1.0  # how far ahead on the path the head steers for
JAMMED_M = 0.02
Steering = Annotated[
    float,
    from_zero(2, "1"),
    about("bend of all joints for each radian that the path leads aside; 0: it goes where it goes"),
]


def aside_rad(nodes_w: NDArray[np.float64], aim_w: NDArray[np.float64]) -> float:
    """Direction of `aim_w`, (2,), from that of a body, (n, 2) tail to head; whole turns are left in."""
    along = nodes_w[-1] - nodes_w[0]
    return math.atan2(aim_w[1], aim_w[0]) - math.atan2(along[1], along[0])


class LateralUndulation:
    """A wave of the yaw joints from head to tail."""

    class Settings(FileStruct, frozen=True, kw_only=True):
        """The wave, and how much it is bent towards the goal."""

        amplitude_rad: Annotated[float, from_zero(2, "rad"), about("swing of every joint to each side")] = 0.5
        period_s: Annotated[float, above(100, "s"), about("of the wave")] = 2.0
        lag_rad: Annotated[
            float,
            bounded(-3.2, 3.2, "rad"),
            about("phase of a joint behind the one ahead of it; below 0 the wave travels to the head"),
        ] = 0.9
        steering: Steering = 0.0
        blend_s: Blend = 1.0

    def __init__(self, robot: Description, settings: Settings) -> None:
        self._robot, self._set, self._body = robot, settings, PlanarBody(robot)
        self._bumpless = BumplessReference(robot, settings.blend_s)
        self._phase_rad = 0.0

    def update(self, view: View) -> Action:
        """The wave goes on while there is a path to go along."""
        reference = self.reference_rad(view, view.period_s if motion_wanted(view) else 0.0)
        return Action(self._bumpless.follow(view, reference), Report(reference_rad=reference.tolist()))

    def start_from(self, angles_rad: NDArray[np.float64]) -> None:
        """Choose the phase at which the wave is most like a shape, (n_joints,)."""
        lags = self._set.lag_rad * np.arange(len(self._body.bends))[::-1]
        self._phase_rad = float(np.angle(1j * (angles_rad[self._body.bends] @ np.exp(1j * lags))))

    def reference_rad(self, view: View, passed_s: float) -> NDArray[np.float64]:
        """Angles of all joints, a time later than before."""
        self._phase_rad += math.tau * passed_s / self._set.period_s
        turns = np.arange(len(self._body.bends))[::-1]  # 0 at the head
        reference = np.zeros(len(self._robot.joints))
        waves = np.sin(self._phase_rad - self._set.lag_rad * turns)
        reference[self._body.bends] = self._amplitude_rad(view, waves, passed_s) * waves + self._bend_rad(view)
        return reference

    def _amplitude_rad(self, _view: View, _waves: NDArray[np.float64], _passed_s: float) -> float | NDArray[np.float64]:
        return self._set.amplitude_rad

    def _bend_rad(self, view: View) -> float | NDArray[np.float64]:
        """Bend of every joint that turns the body towards the path ahead.

        A body that moves by a wave to the head turns against its bend.
        """
        if self._set.steering == 0.0 or view.world is None or view.trajectory is None:
            return 0.0
        nodes = self._body.nodes_w(view.world, view.joints.angle_rad).T
        path = np.array(view.trajectory.path_w)
        ahead = path[np.argmin(np.hypot(*(path - nodes[-1]).T)) :]
        aim = ahead[min(np.searchsorted(np.hypot(*(ahead - nodes[-1]).T), AIM_M), len(ahead) - 1)] - nodes[-1]
        off = math.remainder(aside_rad(nodes, aim), math.tau)
        return math.copysign(self._set.steering, self._set.lag_rad) * off / len(self._body.bends)


class HeadSteeredUndulation(LateralUndulation):
    """A wave that is bent towards where the path leads."""

    class Settings(LateralUndulation.Settings, frozen=True, kw_only=True):
        """As of lateral undulation, with steering."""

        steering: Steering = 0.8


class CompliantUndulation(HeadSteeredUndulation):
    """A wave whose amplitude A yields to the torques on it: A follows A0 + softness sum(w_i tau_i), tau_i from outside.

    w_i = dtheta_i/dA is the wave itself, so the sum is the generalized force on A.
    """

    MEASURES = ("torque",)

    class Settings(HeadSteeredUndulation.Settings, frozen=True, kw_only=True):
        """As of head-steered undulation, with a softness."""

        softness_rad_per_nm: Annotated[
            float,
            from_zero(10, "rad/(N*m)"),
            about("how far the amplitude yields to the torque that obstacles put on the wave"),
        ] = 0.05
        yield_s: Annotated[float, above(10, "s"), about("time constant with which it yields")] = 0.2
        jam_after_s: Annotated[
            float,
            from_zero(1000, "s"),
            about("in which a jammed body comes no 2 cm on, until its wave travels the other way; 0: never"),
        ] = 0.0
        back_s: Annotated[float, above(1000, "s"), about("how long it then does so")] = 1.0

    def __init__(self, robot: Description, settings: Settings) -> None:
        super().__init__(robot, settings)
        self._now_rad = settings.amplitude_rad
        self._back_s = settings.back_s
        self._jam = Standstill(settings.jam_after_s) if settings.jam_after_s > 0.0 else None
        self._back_until_s = -math.inf

    def reference_rad(self, view: View, passed_s: float) -> NDArray[np.float64]:
        """Angles of all joints, a time later than before, or earlier while a jam is resolved."""
        if self._jam is not None and view.world is not None and passed_s > 0.0:
            if view.time_s < self._back_until_s:
                passed_s = -passed_s
            else:
                middle_w = self._body.nodes_w(view.world, view.joints.angle_rad).mean(axis=1)
                if self._jam.seen(view.time_s, passed_s, middle_w, JAMMED_M):
                    self._back_until_s = view.time_s + self._back_s
                    self._jam.forget()
        return super().reference_rad(view, passed_s)

    def _amplitude_rad(self, view: View, waves: NDArray[np.float64], passed_s: float) -> float:
        config = self._set
        assert isinstance(config, CompliantUndulation.Settings)
        from_outside_nm = -float(waves @ np.array(view.joints.torque_nm)[self._body.bends])
        wanted = config.amplitude_rad + config.softness_rad_per_nm * from_outside_nm
        bounded = min(max(wanted, 0.0), 2.0 * config.amplitude_rad)
        self._now_rad += (1.0 - math.exp(-abs(passed_s) / config.yield_s)) * (bounded - self._now_rad)
        return self._now_rad
