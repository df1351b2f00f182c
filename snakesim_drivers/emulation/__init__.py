"""The body behind emulated drives: a physics model that moves under the drives' motors.

`emulated_body`    the body of any driver type, as its emulator uses it: shafts, supply, heat and injected faults
`shared_physics`   what all emulated drives of a robot share: physics model, motors, heat and camera, on one clock
`drive_emulator`   base class of the emulated drives of a driver type
`emulator_child`   the process of emulated drives, as the program that started it sees it
`mounted`          how the emulated drives are really mounted, which a robot file may state wrongly
`inertia`          the simplest physics model: every joint rotates an inertia of its own
`bending_hand`     a hand that bends joints of that model whose motors are off
"""
