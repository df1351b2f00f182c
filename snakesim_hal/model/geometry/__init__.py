"""Geometry of paths, of the chain of links, and of obstacles.

`route`       a route on the ground, by arc length
`kinematics`  poses of all links from the pose of the base and the joint angles
`outlines`    obstacles and links as seen from above, and distances between them
"""
