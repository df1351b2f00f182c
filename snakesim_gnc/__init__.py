"""Guidance, navigation and control: pure cores, and one thin service around each.

`guidance`     contacts, known obstacles and body pose -> a world model
`navigation`   mission or velocity intent -> a trajectory
`control`      trajectory and world model -> set-points of every joint; pluggable

Everything here talks to the HAL's client only. It imports no backend, names none, and never asks which one it drives.
"""
