"""What every driver type of drives on CAN has besides its protocol. A driver type subclasses three classes.

`drives`   the drives, as the kit of `snakesim_drivers.kit` has them: bring-up, questions, strangers, buses
`backend`  settings and checks, and the buses that it opens      `traffic`  the load of a bus
`emulator`     emulated drives at the other end                       `command`  runs them as a process
"""
