"""Everything that a driver type of drives on CAN needs besides its protocol. A driver type subclasses three classes.

`drives`    `CanDrives`: bring-up, requests, unknown nodes and commands on one bus
`emulator`  `CanEmulator`: emulated drives at the other end of the bus
`backend`   `CanDriveBackend`: settings, checks, and the buses that it opens

`traffic`   the load of a bus            `command`  runs emulated drives as a process
"""
