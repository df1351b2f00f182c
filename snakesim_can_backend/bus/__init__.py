"""One CAN bus.

`bus`         opens, sends, receives; priorities and full queues     `bus_errors`  its errors, in words
`adapter`     any adapter of python-can; which wire a channel is
`bus_faults`  injected faults                                        `log`         every frame, in candump's format
`load`        the bus load of a configuration; refuses one that does not fit
"""
