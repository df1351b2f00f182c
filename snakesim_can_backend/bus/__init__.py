"""One CAN bus.

`bus`         opens, sends, receives; priorities and full queues     `bus_errors`  its errors, in words
`bus_faults`  injected faults                                        `log`         every frame, in candump's format
`load`        the bus load of a configuration; refuses one that does not fit
"""
