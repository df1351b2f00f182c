"""What keeps a robot safe. Pure: no clock, no I/O, no threads; time comes in as a number.

`lifecycle`   disarmed, armed, fault, estop, and what arming asks for
`lease`       one controller at a time          `gate`       what a command may be, and how far it is limited
`authority`   all of it together: the decision of every tick
`stop_ramp`, `derating`, `plausibility`, `isolation`, `fault_log`   parts of that decision
"""
