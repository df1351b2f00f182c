"""Drives on serial buses: half-duplex RS-485 or TTL behind a USB adapter.

`commands`        `snakesim drive scan`, `emulate` and `load` for these drives
`dynamixel/`      the backend `dynamixel`: Dynamixel X, by protocol 2.0
`feetech/`        the backend `feetech`: Feetech STS, which have no watchdog
`emulation`       emulated servos as a process, and load tables, for every protocol
`servo_bus`       servos on a port: who is read when, silence, second servos, for every protocol
`request_port`    requests and their answers, for every protocol
`wire`            a port, and a pseudo terminal

All else that a driver needs is in `snakesim_drivers.kit`. Imports `snakesim_hal` alone, and pyserial.
"""
