"""Drives on serial buses: half-duplex RS-485 or TTL behind a USB adapter.

`commands`        `snakesim drive scan`, `emulate` and `load` for these drives
`dynamixel/`      the backend `dynamixel`: Dynamixel X, by protocol 2.0
`feetech/`        the backend `feetech`: Feetech STS, which have no watchdog
`servo_backend`   the backend on servos, without a protocol: ports, their load, emulated servos
`emulation`       emulated servos as a process, and load tables, for every protocol
`servo_checks`    checks of one servo before a motor moves, for every protocol
`servo_bus`       the servos of a port: order of reading, silence, duplicate ids, for every protocol
`port_load`       bytes and time of a control cycle on a port, for every protocol
`request_port`    requests and their answers, for every protocol
`stream_decoder`  packets in a stream of bytes, for every protocol
`wire`            a port, and a pseudo terminal

All else that a driver needs is in `snakesim_drivers.kit`. Imports `snakesim_hal` alone, and pyserial.
"""
