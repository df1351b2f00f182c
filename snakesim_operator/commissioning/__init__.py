"""Finding out how a robot is mounted, and whether it is as its file says.

`by_hand`      zero, direction and travel of each joint, from how a person moves it
`capture`      what those movements say; pure
`check`        whether each joint is as its file says, from a run in which each moved by its motor
`judge`        what its encoders, IMUs and motion capture say; pure
`robot_edit`   single values of a robot file
"""
