"""Moves all joints at once so that a record tells friction, rotor inertia, torque constant and response of each.

For a robot that hangs by its tail, head down: on the ground, friction under the body would be taken for that of joints.
Each joint goes slowly back and forth, for dry friction, and on top shakes at frequencies of its own, none of which
another joint has. Neighbors start in opposite directions, so that the body stays near the vertical. The record is
judged by `snakesim identify`.
"""

import math
import random
from typing import Annotated

from snakesim_gnc.control.controller import Action, Report, View, positions
from snakesim_hal.model.files import FileStruct
from snakesim_hal.wire.messages import Description
from snakesim_hal.wire.quantities import about, bounded

MARGIN_RAD = 0.02  # left before a limit
SPEED_SHARE = 0.8  # of the joint's limit
SPREAD = 4  # tones of a joint; each within its quarter of the band
SEED = 25


class Identify:
    """A slow triangle and four tones for each joint, faded in; by position targets."""

    NEEDS = "joints"
    MEASURES = ("torque",)

    class Settings(FileStruct, frozen=True):
        """How far and how fast."""

        swing_rad: Annotated[float, bounded(0.01, 0.5, "rad"), about("slow motion to either side")] = 0.25
        swing_s: Annotated[float, bounded(0.5, 60.0, "s"), about("of the shortest slow motion there and back")] = 2.0
        shake_rad: Annotated[float, bounded(0.0, 0.3, "rad"), about("sum of all tones, at most")] = 0.05
        shake_to_hz: Annotated[float, bounded(0.5, 50.0, "Hz"), about("highest tone; the lowest is a tenth")] = 6.0
        shake_after_s: Annotated[float, bounded(0.0, 600.0, "s"), about("slow motion alone, before")] = 6.0
        fade_s: Annotated[float, bounded(0.1, 10.0, "s"), about("until each reaches its full size")] = 0.5

    def __init__(self, robot: Description, settings: Settings) -> None:
        self._robot, self._settings = robot, settings
        self._start_rad: list[float] = []
        self._last_rad: list[float] = []
        self._tones = tones(len(robot.joints), settings.shake_to_hz)

    def update(self, view: View) -> Action:
        """The next targets; they stay within the limits of every joint."""
        settings = self._settings
        if not self._start_rad:
            self._start_rad = list(view.joints.angle_rad)
        slow = settings.swing_rad * min(view.time_s / settings.fade_s, 1.0)
        shaking_s = view.time_s - settings.shake_after_s
        fast = settings.shake_rad * min(max(shaking_s / settings.fade_s, 0.0), 1.0)
        targets: list[float] = []
        for i, joint in enumerate(self._robot.joints):
            period_s = settings.swing_s * (1 + i / (2 * len(self._robot.joints)))
            tone = sum(share * math.sin(math.tau * hz * shaking_s + phase) for hz, share, phase in self._tones[i])
            offset = (-1) ** (i // 2 + i) * slow * triangle(view.time_s / period_s) + fast * tone
            least, most = joint.angle_min_rad + MARGIN_RAD, joint.angle_max_rad - MARGIN_RAD
            targets.append(min(max(self._start_rad[i] + offset, least), most))
        if self._last_rad:
            steps = [SPEED_SHARE * joint.speed_limit_rad_s * view.period_s for joint in self._robot.joints]
            targets = [
                min(max(target, before - step), before + step)
                for target, before, step in zip(targets, self._last_rad, steps, strict=True)
            ]
        self._last_rad = targets
        why = "shaking every joint" if fast else "slowly back and forth, every joint"
        return Action(positions(self._robot, targets), Report(why=why, reference_rad=targets))


def triangle(turns: float) -> float:
    """From 0 up to 1, down to -1, and back, in one turn."""
    return 4 * abs((turns - 0.25) % 1.0 - 0.5) - 1.0


def tones(joints: int, to_hz: float) -> list[list[tuple[float, float, float]]]:
    """Frequency, share and phase of each joint's tones: no two joints have one in common, and shares sum to 1."""
    pick = random.Random(SEED)
    min_rate_hz = to_hz / 10
    count = SPREAD * joints
    grid_hz = [min_rate_hz * (to_hz / min_rate_hz) ** (k / max(count - 1, 1)) for k in range(count)]
    made: list[list[tuple[float, float, float]]] = []
    for i in range(joints):
        own = [grid_hz[i + joints * k] for k in range(SPREAD)]
        whole = sum(hz**-0.5 for hz in own)
        made.append([(hz, hz**-0.5 / whole, pick.uniform(0, math.tau)) for hz in own])
    return made
