"""Commands on running robots.

`watching`, `commanding`, `setup`   the arguments of all these commands; they import little, so that a stop is quick
`robot_selection`, `targets`   which robots a command addresses: those of this machine, or of a network
`status`, `echo`   read     `command`, `fault`, `stop`, `stop_by_query`, `stop_result`   act: arm, clear; emergency stop
`schemas`, `completion`, `scenario_files`   need no robot
"""
