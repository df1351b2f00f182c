"""The body behind emulated drives: a physics model that moves under the drives' motors.

`emulated_body`   the body of any driver type: a physics model, motors and their heat on one clock
`mounted`     how the emulated drives are really mounted, which a robot file may state wrongly
`inertia`     the simplest physics model: every joint turns an inertia of its own
"""
