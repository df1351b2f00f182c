"""Finding out how a robot is mounted, and whether it is as its file says.

`by_hand`      zero, direction and travel of each joint, from how a person moves it
`capture`      what those movements say; pure
`check`        whether each joint is as its file says, from a run in which each moved by its motor
`judge`        what its encoders, IMUs and motion capture say; pure
`identify`     what each joint is, from a run in which a hanging robot was shaken: printed, drawn, written down
`identification` of all joints; `estimate` of one, `hanging` what its links need; pure. `identified_page` draws
`jog`          one joint, moved by its motor while a key is held
`robot_edit`   single values of a robot file
"""
