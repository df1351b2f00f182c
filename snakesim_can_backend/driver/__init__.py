"""The backend `can`.

`backend`     CanBackend, tick by tick
`bring_up`    finds every module and checks it, enabling nothing; `parameters` compares what it holds
`reports`     what modules report, as arrays; `module_monitor` says what is wrong with which module
`sensors`     IMU, contacts, power; `mocap` and `mocap_times` for the base's pose
`own_twins`   module twins, where the scenario asks for them
"""
