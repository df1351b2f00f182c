"""Control: from trajectory and world model to setpoints of every joint. Controllers are plug-ins.

Their base class, their observations and commands are in `snakesim_hal.controller`.

Controllers:

`hold`, `path_following`, `undulation`, `policy`   one module each
`obstacle_aided`, `obstacle_triplet`, `gaits`      one folder each
`joint_check`, `identify`   motions whose recordings are evaluated afterwards

Parts that controllers share:

`progress`        position and speed along the path
`bumpless`        changes of mode and reference without a jump
`climb`           pitch angles over platforms
`contact_forces`, `standstill`    measured contact forces, and whether the body moves
`observations`, `goal_progress`   what a learned policy observes

The process that runs a controller is in `service`.
"""
