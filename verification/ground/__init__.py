"""Compares the laws of ground and friction with integrators that do not use MuJoCo, and measures what they cost.

`wheeled`  a snake with wheels as bodies in plain MuJoCo
`tables`   the comparisons
`slopes_and_fluids`   those of slopes and of the fluid
`pictures`   the pictures of terrain in the documentation
`cost`     the CPU time of a physics step with each law
"""
