"""The safety rules of a robot. Pure: no clock, no I/O, no threads; time is passed in as a number.

`lifecycle`   disarmed, armed, fault, estop, and the conditions for arming
`lease`       one controller at a time          `limiter`       checks and limits of commands
`authority`   all of these together: the decision of every tick
`stop_ramp`, `derating`, `plausibility`, `isolation`, `fault_log`   parts of that decision
"""
