"""Commands on robots that are there.

`targets`   which robots a command is about: those of this machine, or of a network
`status`, `echo`   look     `command`, `stop`, `fault`   act: arm, disarm, clear; emergency stop; faults on request
`schemas`, `completion`   need no robot
"""
