"""Geometry of a planar snake that guidance, navigation and control share. Pure functions.

`planar`         vectors and curves in the ground plane
`planar_body`    the robot as a planar chain that bends at its yaw joints
`body_on_path`   joint angles of a body that lies on a path
"""
