"""The safety rules of a robot. Pure: no clock, no I/O, no threads; time is passed in as a number.

`lifecycle`   disarmed, armed, fault, estop, and the conditions for arming
`lease`       one controller at a time          `limiter`       checks and limits of commands
`authority`   all of these together: the decision of every tick
`joint_limits`, `limit_names`   the values that the limiter works with; names of the limits that changed a command
`stop_ramp`, `derating`, `plausibility`, `isolation`, `cables`, `fault_log`   parts of that decision
"""
