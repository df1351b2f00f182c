"""The joint check with drawn shapes: a person bends a robot without IMUs into them, and its encoders are compared.

`design`    chooses the joint angles of the shapes, so that each joint can be identified by them; pure
`decide`    decides which properties of each joint are confirmed, wrong or unknown; pure
`outline`   the outlines of the links in a shape, in mm; pure
`pages`     divides a drawing into sheets of paper; pure
`drawing`   writes drawings as PDF or SVG
`draw`      `snakesim robot shape draw`
`check`     `snakesim robot shape check`: guides the person, and records the check in the robot file
"""
