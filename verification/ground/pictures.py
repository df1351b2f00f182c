"""Draw the pictures of terrain in the documentation: `python -m verification.ground.pictures [SCENARIO ...]`.

The command runs each scenario with its seed, and writes a picture of one moment to docs/pictures/terrain-SCENARIO.png.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.image import imsave

from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_operator.run.in_process import simulate
from snakesim_sim_backend.film import FollowCamera

PICTURES = Path(__file__).parents[2] / "docs" / "pictures"
WIDTH = 1000  # pixels
HEIGHT = 460  # pixels


class Shot(NamedTuple):
    """The time of a picture in a run, and the position of the camera."""

    time_s: float
    azimuth_deg: float
    elevation_deg: float
    distance_per_length: float  # of the camera from the robot, in lengths of the robot


SHOTS = {
    "pipe": Shot(6.0, 70.0, -35.0, 0.85),
    "over_pipe": Shot(5.0, 20.0, -25.0, 0.9),
    "stairs": Shot(4.0, 115.0, -18.0, 0.9),
    "swimming": Shot(4.0, 60.0, -35.0, 1.0),
    "gaps": Shot(4.0, 60.0, -25.0, 1.1),
}


def draw_shot(scenario: str, shot: Shot) -> None:
    """Run a scenario until the time of its shot, and write the picture."""
    set_option = parse_set_option(f"duration_s={shot.time_s}")
    record = simulate(load_scenario(scenario, [set_option]).config).record
    row = int(np.flatnonzero(record.has_pose)[-1])
    nodes_w = record.find_body_points_w(row)
    assert nodes_w is not None
    film = FollowCamera(record.config, WIDTH, HEIGHT)
    camera = film.camera
    camera.azimuth = shot.azimuth_deg
    camera.elevation = shot.elevation_deg
    camera.distance = shot.distance_per_length * record.config.robot.length_m
    picture = film.render_picture(
        record.position_w_m[row],
        record.orientation_wxyz[row],
        record.angle_rad[row],
        nodes_w.mean(axis=0),
    )
    film.close()
    path = PICTURES / f"terrain-{scenario.replace('_', '-')}.png"
    imsave(path, picture)
    print(f"wrote {path}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw the pictures of the given scenarios, or of all, and return the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m verification.ground.pictures", description=__doc__
    )
    parser.add_argument("scenarios", nargs="*", choices=[[], *SHOTS], metavar="SCENARIO")
    options = parser.parse_args(arguments)
    for scenario in options.scenarios or SHOTS:
        draw_shot(scenario, SHOTS[scenario])
    return 0


if __name__ == "__main__":
    sys.exit(main())
