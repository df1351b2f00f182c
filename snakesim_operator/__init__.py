"""The user interface: the `snakesim` command.

From the ground up:

`base`             what several parts use: extras, robot selection, the worker cluster
`recording`        writes and reads `recording.mcap`
`results`          reads the log of a run: summary, report, compare
`robot_commands`   commands to running robots: status, arm, stop, parameters, faults, teleoperation
`run`              `snakesim run`: starts, supervises and ends the processes of a run
`playback`         recordings: replay, export, video
`monitoring`, `this_computer`   commands that only watch, and commands that need no robot
`features`         independent features, each of which may be left out
`cli`              the command line, assembled from the `arguments` of each part; start reading here

Backends, controllers and services are found through entry points, so this package imports the HAL only.
"""
