"""One CAN bus.

`bus`             opens, sends and receives; waits for frames
`adapter`         any adapter of python-can; parses the name of a channel
`bus_errors`      the errors of a bus, and what a person can do about them
`bus_faults`      injected faults
`load`            the bus load of a configuration; refuses one that does not fit
`log`             writes every frame, in candump's format; `read_log` reads such files
`unknown_frames`  lists the frames of other devices on the bus
"""
