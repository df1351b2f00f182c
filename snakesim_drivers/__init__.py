"""Everything that a driver of real joints needs except its protocol, and what emulated drives move.

`template`         the package of a driver type that `snakesim drive new` writes
`kit`              a complete backend around the drives of one driver type, or of several
`emulation`        the body that emulated drives move
`mounting`         between a joint and the shaft of its drive: sign, zero and gear
`motion_capture`   receives the base pose from a motion-capture system, and emulates such a system

A simulator needs none of this. Imports the HAL only: no bus library, and no physics engine.
"""
