"""The backend `can`.

`backend`     CanBackend, on the kit of `snakesim_drivers.kit`      `modules`  what a tick says to modules
`bring_up`    finds and checks every module, enabling none; `parameters` checks their parameters
`reports`     the modules' reports as arrays; `module_monitor` detects module and bus faults
`sensors`     IMU, contacts, power
`own_emulators`   emulated joint modules, if the scenario asks for them
"""
