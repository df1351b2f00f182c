"""The obstacle-triplet controller: statics of three contacts, the choice of contacts and joint, and the control law.

`statics`     three contacts and one joint: forces and torques (the paper's equations, and a correction to them)
`contacts`    where the path passes obstacles, and which of these places the body is at
`selection`   which three of them, and which joint
`stall`       standing still: noticed, and told apart by cause
`controller`  puts them together; the entry point `obstacle_triplet`. `settings` and `telemetry` belong to it

Where the body is on its path, and bumpless changes of mode, are shared with other controllers: see the package above.
"""

from snakesim_gnc.control.obstacle_triplet.controller import ObstacleTriplet
from snakesim_gnc.control.obstacle_triplet.settings import Settings
from snakesim_gnc.control.obstacle_triplet.statics import TripletSolution, bending_torque_nm, solve_triplet

__all__ = ["ObstacleTriplet", "Settings", "TripletSolution", "bending_torque_nm", "solve_triplet"]
