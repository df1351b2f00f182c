"""Guidance, navigation and control: pure cores, and one thin service around each.

`geometry`     a planar snake: vectors, the body as a chain, a body on a path
`guidance`     contacts, known obstacles and body pose -> a world model
`navigation`   mission or velocity intent -> a trajectory
`control`      trajectory and world model -> setpoints of every joint; pluggable

Everything here uses only the HAL's client. It imports no backend and names none.
"""
