"""Contact-search gait: a body that does not advance moves by a wave for a while, to where it may push again.

It does not matter whether the contacts would allow a push: a body that they hold does not advance either, and a body
that could push where it lies mostly stands again a moment later. Navigation plans a new path from wherever the wave
leads.

There are two waves. The force-feedback wave (`force_feedback_wave.py`) pushes off whatever it touches. Without contact
it moves backward, because on ground with isotropic friction a body moves the way that its wave travels. The forward
wave travels from tail to head, so it advances without contacts, at 8 cm/s, but obstacles hold it. A search begins with
the force-feedback wave if obstacles are near, and changes waves whenever the goal comes no nearer for a while.

A body that has advanced by pushing lies bent among obstacles. There the force-feedback wave begins at half its speed,
which takes less energy. If that does not bring the goal nearer, it continues as fast as it was trained.
"""

import math

import numpy as np
from msgspec.structs import replace

from snakesim_gnc.control.force_feedback_wave import ForceFeedbackWave, spacing_ratio
from snakesim_gnc.control.standstill import Standstill
from snakesim_gnc.control.undulation import HeadSteeredUndulation, HeadSteeredUndulationParameters, LateralUndulation
from snakesim_hal.base.arrays import Floats
from snakesim_hal.controller import Observation
from snakesim_hal.wire.messages import Description

STANDSTILL_M = 0.02  # a body stands that moves less than this, or less than half of what it should
PROGRESS_M = 0.05  # a wave makes progress if the goal comes so much nearer within PROGRESS_S
PROGRESS_S = 3.0
PUSHED_M = 0.1  # a body that has moved so far since the last search has advanced by pushing
SLOW_TIME_SCALE = 2.0  # of the first wave of such a body
FORWARD_WAVE = HeadSteeredUndulationParameters(amplitude_rad=0.7, period_s=0.8, lag_rad=-0.75, steering=0.3)


class ContactSearch:
    """Decides whether to search, and by which wave."""

    def __init__(self, robot: Description, *, after_s: float, for_s: float) -> None:
        """Prepare the waves with which a stationary body searches for obstacles to push off.

        Args:
            robot: description of the robot.
            after_s: how long the body must be stationary before a search begins; 0: no search ever begins.
            for_s: duration of a search.
        """
        # Waves.
        self._feedback_wave = ForceFeedbackWave(robot)
        self._slow_feedback_wave = ForceFeedbackWave(robot, time_scale=SLOW_TIME_SCALE)
        scale = spacing_ratio(robot)
        forward = replace(
            FORWARD_WAVE,
            amplitude_rad=scale * FORWARD_WAVE.amplitude_rad,
            lag_rad=scale * FORWARD_WAVE.lag_rad,
        )
        self._forward_wave = HeadSteeredUndulation(robot, forward)
        # When to begin.
        self._after_s = after_s
        self._standstill = Standstill(after_s)
        self._origin_w: Floats | None = None  # center of the body when it began to move along the path
        # The search in progress.
        self._wave: LateralUndulation | None = None
        self._for_s = for_s
        self._begin_s = 0.0
        self._progress_s = 0.0  # when the wave last brought the goal nearer
        self._nearest_m = math.inf  # distance of the goal then
        self.changed = False  # a wave began or ended in this tick

    def decide(
        self, observation: Observation, center_w: Floats, *, desired_m_s: float, has_near_obstacles: bool
    ) -> LateralUndulation | None:
        """Decide whether the body searches for contacts at this tick, and by which wave it moves.

        A search begins when the body has been stationary, and ends after its time. If a wave makes no progress, the
        other kind of wave takes over.

        Args:
            observation: inputs of this tick.
            center_w: (2,) m, center of the body.
            desired_m_s: desired speed along the path.
            has_near_obstacles: whether obstacles are within reach of the body.

        Returns:
            The wave to move by, or None to follow the path.
        """
        last_wave = self._wave
        if last_wave is None:
            if self._is_stationary(observation, center_w, abs(desired_m_s)):
                self._begin_s = observation.time_s
                self._begin_wave(self._choose_first_wave(center_w, has_near_obstacles=has_near_obstacles), observation)
        elif observation.time_s - self._begin_s >= self._for_s:
            self.stop()
        elif not self._makes_progress(observation, center_w):
            if last_wave is self._forward_wave:
                self._begin_wave(self._feedback_wave, observation)
            else:
                self._begin_wave(self._forward_wave, observation)
        self.changed = self._wave is not last_wave
        return self._wave

    def stop(self) -> None:
        """End the search; the next one begins after the body has been stationary for the whole time again."""
        if self._wave is not None:
            self._origin_w = None
        self._wave = None
        self._standstill.reset()

    def _choose_first_wave(self, center_w: Floats, *, has_near_obstacles: bool) -> LateralUndulation:
        if not has_near_obstacles:
            return self._forward_wave
        if self._origin_w is not None and math.dist(center_w, self._origin_w) > PUSHED_M:
            return self._slow_feedback_wave
        return self._feedback_wave

    def _begin_wave(self, wave: LateralUndulation, observation: Observation) -> None:
        self._wave = wave
        self._progress_s = observation.time_s
        self._nearest_m = math.inf
        wave.start_from(np.array(observation.joints.angle_rad))

    def _makes_progress(self, observation: Observation, center_w: Floats) -> bool:
        """Whether the wave has brought the goal nearer within the last PROGRESS_S."""
        trajectory = observation.trajectory
        if trajectory is None:
            return True
        goal_w = trajectory.goal_w or trajectory.path_w[-1]
        distance_m = math.dist(center_w, goal_w)
        if distance_m < self._nearest_m - PROGRESS_M:
            self._progress_s = observation.time_s
            self._nearest_m = distance_m
        return observation.time_s - self._progress_s < PROGRESS_S

    def _is_stationary(self, observation: Observation, center_w: Floats, desired_m_s: float) -> bool:
        if self._origin_w is None:
            self._origin_w = center_w
        max_distance_m = min(STANDSTILL_M, 0.5 * desired_m_s * self._after_s)
        return self._standstill.update(observation.time_s, observation.period_s, center_w, max_distance_m)
