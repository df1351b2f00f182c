"""Contact-search gait: a body that does not advance moves by a wave for a while, to where it may push again.

It does not matter whether the contacts would allow a push: a body that they hold does not advance either, and a body
that could push where it lies mostly stands again a moment later. Navigation plans a new path from wherever the wave
leads.

There are two waves. The force-feedback wave (`force_feedback_wave.py`) pushes off whatever it touches. Without contact
it moves backward, because on ground with isotropic friction a body moves the way that its wave travels. The forward
wave travels from tail to head, so it advances without contacts, at 8 cm/s, but obstacles hold it. A search begins with
the force-feedback wave if obstacles are near, and changes waves whenever the goal comes no nearer for a while.

A body that has advanced by pushing lies bent among obstacles. There the force-feedback wave begins slow, wide and
smooth, which takes less energy. If that does not bring the goal nearer, it continues as it was trained.
"""

import math

import numpy as np
from msgspec.structs import replace

from snakesim_gnc.control.obstacle_aided.force_feedback_wave import (
    ForceFeedbackWave,
    compute_joint_spacing_ratio,
)
from snakesim_gnc.control.standstill import StandstillDetector
from snakesim_gnc.control.undulation import (
    HeadSteeredUndulation,
    HeadSteeredUndulationParameters,
    LateralUndulation,
)
from snakesim_hal.base.arrays import Floats
from snakesim_hal.controller import Observation
from snakesim_hal.wire.messages import RobotDescription

# A body stands that moves less than this, or less than half of what it should.
MAX_STANDSTILL_DISTANCE_M = 0.02
# A wave makes progress if the goal comes so much nearer within PROGRESS_TIMEOUT_S.
MIN_PROGRESS_M = 0.05
PROGRESS_TIMEOUT_S = 3.0
# A body that has moved so far since the last search has advanced by pushing.
MIN_PUSHED_DISTANCE_M = 0.1
# How the first wave of such a body differs from the trained wave. Found by trials in random scenes, see
# docs/development/random-scene-experiments.md.
SLOW_TIME_SCALE = 2.0
SLOW_AMPLITUDE_SCALE = 1.3
SLOW_SMOOTHING_S = 0.1  # removes an oscillation at about 22 Hz, which takes energy
FORWARD_WAVE = HeadSteeredUndulationParameters(
    amplitude_rad=0.7, period_s=0.8, lag_rad=-0.75, steering=0.3
)


class ContactSearch:
    """Decides whether to search, and by which wave."""

    def __init__(
        self, robot: RobotDescription, *, standstill_duration_s: float, search_duration_s: float
    ) -> None:
        """Prepare the waves with which a stationary body searches for obstacles to push off.

        Args:
            robot: Description of the robot.
            standstill_duration_s: Time for which the body must be stationary before a search starts; 0 to never search.
            search_duration_s: Maximum duration of a search.
        """
        # Waves.
        self._feedback_wave = ForceFeedbackWave(robot)
        self._slow_feedback_wave = ForceFeedbackWave(
            robot,
            time_scale=SLOW_TIME_SCALE,
            amplitude_scale=SLOW_AMPLITUDE_SCALE,
            smoothing_s=SLOW_SMOOTHING_S,
        )
        scale = compute_joint_spacing_ratio(robot)
        forward = replace(
            FORWARD_WAVE,
            amplitude_rad=scale * FORWARD_WAVE.amplitude_rad,
            lag_rad=scale * FORWARD_WAVE.lag_rad,
        )
        self._forward_wave = HeadSteeredUndulation(robot, forward)
        # When to begin.
        self._standstill_duration_s = standstill_duration_s
        self._standstill_detector = StandstillDetector(standstill_duration_s)
        # Center of the body when it began to move along the path.
        self._path_start_w: Floats | None = None
        # The search in progress.
        self._wave: LateralUndulation | None = None
        self._search_duration_s = search_duration_s
        self._search_start_s = 0.0
        self._last_progress_s = 0.0  # when the wave last brought the goal nearer
        self._goal_distance_at_progress_m = math.inf  # distance of the goal then
        self.has_changed_wave = False  # a wave began or ended in this tick

    def choose_wave(
        self,
        observation: Observation,
        center_w: Floats,
        *,
        desired_m_s: float,
        has_near_obstacles: bool,
    ) -> LateralUndulation | None:
        """Choose the wave by which the body moves at this tick, or none if it should follow its path.

        A search starts when the body has been stationary, and ends after its duration. If a wave makes no progress, the
        other kind of wave takes over. `has_changed_wave` is whether the choice differs from that of the last tick.

        Args:
            observation: Inputs of this tick.
            center_w: (2,) m, center of the body.
            desired_m_s: Desired speed along the path.
            has_near_obstacles: Whether obstacles are within reach of the body.

        Returns:
            The wave to move by, or None to follow the path.
        """
        last_wave = self._wave
        if last_wave is None:
            if self._is_stationary(observation, center_w, abs(desired_m_s)):
                self._search_start_s = observation.time_s
                self._start_wave(
                    self._choose_first_wave(center_w, has_near_obstacles=has_near_obstacles),
                    observation,
                )
        elif observation.time_s - self._search_start_s >= self._search_duration_s:
            self.stop()
        elif not self._makes_progress(observation, center_w):
            if last_wave is self._forward_wave:
                self._start_wave(self._feedback_wave, observation)
            else:
                self._start_wave(self._forward_wave, observation)
        self.has_changed_wave = self._wave is not last_wave
        return self._wave

    def stop(self) -> None:
        """End the search. The next one starts after the body has been stationary for the whole duration again."""
        if self._wave is not None:
            self._path_start_w = None
        self._wave = None
        self._standstill_detector.reset()

    def _choose_first_wave(
        self, center_w: Floats, *, has_near_obstacles: bool
    ) -> LateralUndulation:
        """Return the wave with which a search starts; it is slower if the body has advanced since the last search."""
        if not has_near_obstacles:
            return self._forward_wave
        if (
            self._path_start_w is not None
            and math.dist(center_w, self._path_start_w) > MIN_PUSHED_DISTANCE_M
        ):
            return self._slow_feedback_wave
        return self._feedback_wave

    def _start_wave(self, wave: LateralUndulation, observation: Observation) -> None:
        """Continue with this wave, at the phase that is most similar to the measured shape of the body."""
        self._wave = wave
        self._last_progress_s = observation.time_s
        self._goal_distance_at_progress_m = math.inf
        wave.match_phase_to_angles(np.array(observation.joints.angle_rad))

    def _makes_progress(self, observation: Observation, center_w: Floats) -> bool:
        """Return whether the wave has brought the body nearer to its goal within the last PROGRESS_TIMEOUT_S.

        It also stores the distance of the goal and the time if the body has come nearer by MIN_PROGRESS_M.
        """
        trajectory = observation.trajectory
        if trajectory is None:
            return True
        goal_w = trajectory.goal_w or trajectory.path_w[-1]
        distance_m = math.dist(center_w, goal_w)
        if distance_m < self._goal_distance_at_progress_m - MIN_PROGRESS_M:
            self._last_progress_s = observation.time_s
            self._goal_distance_at_progress_m = distance_m
        return observation.time_s - self._last_progress_s < PROGRESS_TIMEOUT_S

    def _is_stationary(
        self, observation: Observation, center_w: Floats, desired_m_s: float
    ) -> bool:
        """Add the center of the body at this tick, and return whether the body has been stationary long enough."""
        if self._path_start_w is None:
            self._path_start_w = center_w
        max_distance_m = min(
            MAX_STANDSTILL_DISTANCE_M, 0.5 * desired_m_s * self._standstill_duration_s
        )
        return self._standstill_detector.update(
            observation.time_s, observation.period_s, center_w, max_distance_m
        )
