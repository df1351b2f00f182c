"""Compares the laws of ground and friction with integrators that do not use MuJoCo, and measures what they cost.

`wheeled`            simulates a snake with wheels as bodies in plain MuJoCo
`tables`             compares waves, gliding, drag and wheels
`slopes_and_fluids`  compares slopes and fluids
`pictures`           draws the pictures of terrain in the documentation
`cost`               measures the CPU time of a physics step with each law
"""
