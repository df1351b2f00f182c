"""Commands to running robots: status, arm, disarm, reset, emergency stop, parameters, faults, teleoperation.

`commanding`, `simulator_commands`   these commands; they import little, so that a stop starts quickly
`status`, `command`, `parameters`, `fault`, `teleop`   one command each
`stop`, `stop_by_query`, `stop_result`   the emergency stop
"""
