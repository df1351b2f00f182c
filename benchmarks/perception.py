"""`python -m benchmarks.perception`: maps of fields that guidance does not know, against the truth; and their cost.

The snake follows the launch row into each field (path following, so that the motion does not depend on the map), with a
depth camera of 160 x 120 pixels. Every 0.12 s of the run the map within 1 m of the head is scored. Without a pose
sensor the map is scored as the robot sees it: its own position error is taken out, and reported beside it.
"""

import argparse
import math
import time
from collections.abc import Callable
from typing import Any, ClassVar

import msgspec
import numpy as np

from snakesim_gnc.guidance.perceived_world import PerceivedWorld
from snakesim_gnc.guidance.service import Guidance
from snakesim_hal.model.kinematics import rotation_from_quaternion, yaw_of
from snakesim_hal.model.plugins import SERVICES, offered
from snakesim_hal.model.scenario import RunConfig, load, parse_set
from snakesim_hal.wire.messages import Clock, Message, Pose, World
from snakesim_operator.results.map_score import MapScore, moved, score
from snakesim_operator.results.record import RunRecord
from snakesim_operator.run.in_process import simulate

HOW = ("robot=planar13_camera", "controller=path_following", "control.look_ahead_m=0.1", 'mission.map="perceived"')
HEADER = (
    "| scene, runs | sensors | position, median (90 %) | facing side | misses | ghosts | error / sd "
    "| place off, at the end | reported sd | CPU an image, median (95 %) |\n|---|---|---|---|---|---|---|---|---|---|"
)


class PoseBlind(Guidance):
    """Guidance whose poses are taken away. The run has them, for the truth; so control is told that they are fresh."""

    def outputs(self, clock: Clock) -> list[tuple[str, Message]] | None:
        """With the stamp that control waits for."""
        reported = super().outputs(clock)
        return (
            None
            if reported is None
            else [
                (key, msgspec.structs.replace(m, pose_stamp_ns=m.stamp_ns) if isinstance(m, World) else m)
                for key, m in reported
            ]
        )


class Timed:
    """CPU time of a method of PerceivedWorld."""

    taken_s: ClassVar[list[float]] = []

    def __init__(self, method: Callable[..., Any]) -> None:
        self._method = method

    def __get__(self, one: Any, _: Any = None) -> Callable[..., Any]:
        def timed(*arguments: Any) -> Any:
            began = time.process_time()
            try:
                return self._method(one, *arguments)
            finally:
                self.taken_s.append(time.process_time() - began)

        return timed


def main() -> int:
    """Print a row a scene and set of sensors."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--fields", type=int, default=5, help="random fields, of the seeds 1001, 1002, ...")
    parser.add_argument("--seconds", type=float, default=8.0, help="of each run")
    arguments = parser.parse_args()
    PerceivedWorld.take_look = Timed(PerceivedWorld.take_look)  # pyright: ignore[reportAttributeAccessIssue]
    given = PerceivedWorld.take_pose
    fields = [f"scene.random_field.0.seed={1001 + k}" for k in range(arguments.fields)]
    print(HEADER, flush=True)
    for scene, variants in (("peg_row", [""]), ("clutter", fields)):
        for pose in (True, False):
            PerceivedWorld.take_pose = given if pose else _ignore
            total, off, sds = MapScore(), [], []
            Timed.taken_s.clear()
            for variant in variants:
                sets = [*HOW, f"duration_s={arguments.seconds}", *filter(None, [variant])]
                record = run(load(scene, [parse_set(text) for text in sets]).config, pose=pose)
                last_off_m, last_sd_m = add_up(record, total, pose=pose)
                off.append(last_off_m)
                sds.append(last_sd_m)
            print(row(f"{scene}, {len(variants)}", pose, total, off, sds), flush=True)
    return 0


def _ignore(self: PerceivedWorld, pose: Pose) -> None:
    """No pose sensor."""


def run(config: RunConfig, *, pose: bool) -> RunRecord:
    """One run in this process."""
    with offered(SERVICES, "guidance", Guidance if pose else PoseBlind):
        return simulate(config).record


def add_up(record: RunRecord, total: MapScore, *, pose: bool) -> tuple[float, float]:
    """Score every map of a run; how far off the robot thought itself at the end, and its sd."""
    truth = [placed.obstacle for placed in record.placed if not placed.walkable]
    off_m = 0.0
    for world in record.worlds:
        row = record.row_at(world.stamp_ns * 1e-9)
        nodes = record.nodes_w(row)
        if nodes is None or world.stamp_ns < 500_000_000:
            continue
        real = (*record.position_w[row, :2].tolist(), heading(record.orientation_wxyz[row].tolist()))
        thought = (*world.base_position_w[:2], heading(world.base_orientation_wxyz))
        off_m = math.dist(real[:2], thought[:2])
        reported = world.obstacles if pose else moved(world.obstacles, thought, real)
        along = nodes[-1] - nodes[-2]
        total.add(score(reported, truth, nodes[-1], math.atan2(along[1], along[0])))
    return off_m, record.worlds[-1].base_position_sd_m or 0.0


def heading(wxyz: Any) -> float:
    """Of a quaternion."""
    return yaw_of(rotation_from_quaternion(wxyz))


def row(name: str, pose: bool, total: MapScore, off: list[float], sds: list[float]) -> str:
    """A row of the table."""

    def mm(values: list[float], share: float) -> str:
        return f"{1e3 * float(np.percentile(values, share)):.1f} mm"

    cpu = [1e3 * float(np.percentile(Timed.taken_s, share)) for share in (50, 95)]
    sensors = "camera, touch, pose" if pose else "camera, touch, IMU"
    return (
        f"| {name} | {sensors} | {mm(total.position_m, 50)} ({mm(total.position_m, 90)}) | {mm(total.surface_m, 50)} "
        f"| {total.misses} of {total.visible} | {total.ghosts} of {total.reported} | {np.median(total.in_sd):.2f} "
        f"| {mm(off, 50)} | {mm(sds, 50)} | {cpu[0]:.1f} ms ({cpu[1]:.1f} ms) |"
    )


if __name__ == "__main__":
    raise SystemExit(main())
