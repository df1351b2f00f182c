"""One CAN bus.

`bus`         opens, sends, receives; priorities and full queues     `bus_errors`  its errors, in words
`bus_faults`  faults on request                                      `log`         every frame, in candump's format
`load`        what a configuration asks of the bus, and the refusal of what does not fit
"""
