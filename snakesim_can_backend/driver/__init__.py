"""The backend `can`: the driver of joint modules on CAN buses.

`backend`         `CanBackend`, on the kit of `snakesim_drivers.kit`
`modules`         sends Syncs, setpoints and commands, and collects the answers
`bring_up`        finds and checks every module, and writes its parameters; enables none
`parameters`      plans the parameters, and checks the robot file against protocol and modules
`reports`         the newest reports of all modules, in raw numbers
`module_monitor`  detects faults of modules and buses
`sensors`         makes the sensor messages: joint state, contacts, IMU, power
`own_emulators`   emulated joint modules, if the scenario requires them
`offline`         replays a log of the bus
"""
