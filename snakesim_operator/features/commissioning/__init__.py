"""Finding out how a robot is mounted, and whether it is as its file says.

`by_hand`      zero, direction, gear and travel of each joint, from how a person moves it
`capture`      what those movements say; pure
`check`        whether each joint is as its file says, from a run in which each moved by its motor
`measured`     what was recorded in that run
`judge`        which properties of each joint are confirmed, wrong or unknown; pure
`link_shares`  how far links turned with a joint, and whose module is in whose place; pure
`lost_motion`  backlash; pure
`identify`     what each joint is, from a run in which a hanging robot was shaken: printed, drawn, written down
`identification` of all joints; `estimate` of one, `hanging` what its links need; pure. `identified_page` draws
`jog`          one joint, moved by its motor while a key is held
`robot_edit`   single values of a robot file
"""
