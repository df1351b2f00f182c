"""The obstacle-triplet controller: statics of three contacts, the choice of contacts and joint, and the control law.

`statics`     three contacts and one joint: forces and torques (the paper's equations, and a correction to them)
`contacts`    where the path passes obstacles, and which of these places the body covers
`selection`   the choice of three contacts and a joint
`stall`       detects that the body is stationary, and explains why
`parameters`  the controller's parameters
`telemetry`   what it reports
`controller`  combines these; the entry point `obstacle_triplet`

It shares localization on the path and bumpless mode changes with other controllers: see the package above.
"""

from snakesim_gnc.control.obstacle_triplet.controller import ObstacleTriplet
from snakesim_gnc.control.obstacle_triplet.parameters import TripletParameters
from snakesim_gnc.control.obstacle_triplet.statics import (
    TripletSolution,
    compute_bending_torque_nm,
    solve_triplet,
)

__all__ = [
    "ObstacleTriplet",
    "TripletParameters",
    "TripletSolution",
    "compute_bending_torque_nm",
    "solve_triplet",
]
