"""Control: from trajectory and world model to setpoints of every joint. Controllers are plug-ins.

`controller`        the interface of a controller
`hold`, `path_following`, `obstacle_triplet`   the shipped controllers
`body_on_path`, `progress`, `planar_body`, `bumpless`   shared parts: a chain on a path, its position along it, the
                    body that bends at its yaw joints, and mode changes without a jump
`states`            the four states of the paper's Figure 6
"""
