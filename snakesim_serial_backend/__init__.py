"""Drives on serial buses: half-duplex RS-485 or TTL behind a USB adapter.

`serial_command`  `snakesim drive scan dynamixel`: which servos answer on a port
`dynamixel/`      the backend `dynamixel`: Dynamixel X, by protocol 2.0
`wire`            a port, and a pseudo terminal

All else that a driver needs is in `snakesim_drivers.kit`. Imports `snakesim_hal` alone, and pyserial.
"""
