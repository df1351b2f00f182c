"""Compares the laws of ground and friction with integrators that do not use MuJoCo, and measures what they cost.

`wheeled`  a snake with wheels as bodies in plain MuJoCo
`tables`   the comparisons
`cost`     the CPU time of a physics step with each law
"""
