"""Control: from trajectory and world model to setpoints of every joint. Controllers are plug-ins.

Their base class, their observations and commands are in `snakesim_hal.controller`.

Controllers, one per module:

`hold`, `path_following`, `obstacle_triplet`, `obstacle_aided`, `undulation`, `force_feedback_wave`, `policy`
`gaits`   a folder: the gaits of the literature
`joint_check`, `identify`   motions whose recordings are evaluated afterwards

Parts that controllers share:

`progress`        position and speed along the path
`bumpless`        changes of mode and reference without a jump
`climb`           pitch angles over platforms
`contact_forces`, `contact_search`, `push`, `push_report`, `standstill`   contacts, and what they can push
`observations`, `goal_progress`   what a learned policy observes

The process that runs a controller:

`service`         calls the controller once a tick, and sends its setpoints
`guarded`, `freshness`, `live_parameters`, `update_times`   check its output, its inputs, its parameters and its speed
`state_reports`, `states`, `advance`   the messages of `control/state`, with the four states of the paper's Figure 6
"""
