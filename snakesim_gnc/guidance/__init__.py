"""Guidance: makes a world model of pose, contacts and obstacles for the other services.

`service`           the process, which makes world models with a `world_source`
`surveyed_source`   the source on a known map; `surveyed_world` is its world model
`perceived_source`  the source for a map that begins empty; `perceived_world` is its world model, from sensors alone

What the world models are made of:

`pose`      where the base is
`contacts`  contacts of a robot without contact sensors
`ranging`   scans of lidars and depth cameras
`mapping`   the map that begins empty
"""
