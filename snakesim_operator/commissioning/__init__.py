"""Finding out how a robot is mounted, and whether it is as its file says.

`by_hand`      zero, direction and travel of each joint, from how a person moves it
`capture`      what those movements say; pure
`robot_edit`   single values of a robot file
"""
