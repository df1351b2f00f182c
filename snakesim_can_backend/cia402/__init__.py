"""The backend `cia402`: servo drives with the profile CiA 402 on CANopen, in the cyclic synchronous modes.

`backend`        Cia402Backend: checks
`settings`       the scenario's section of this driver type
`drives`         what the driver sends to the drives of a bus, and how it handles their answers
`servo`          what the driver knows of one drive
`configuration`  what the driver reads from a drive, writes to it and reads back
`limits`         units of a drive, and its limits against those of its joint
`state_machine`  statusword and controlword
`objects`        entries of the object dictionary, and the PDOs that carry them
`frames`, `sdo`  frames as bytes, and one SDO transfer after the other
`eds`            electronic data sheets, by which objects are checked
`emulator`       emulated drives
`node`           their CANopen side

All else is in `snakesim_can_backend.can_drives` and `snakesim_drivers.kit`. Numbers are those of the drive's shaft.
"""
