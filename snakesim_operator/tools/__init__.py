"""Commands on running robots.

`targets`   which robots a command addresses: those of this machine, or of a network
`status`, `echo`   read     `command`, `stop`, `fault`   act: arm, disarm, clear; emergency stop; fault injection
`schemas`, `completion`   need no robot
"""
