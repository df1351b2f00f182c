"""Control: from trajectory and world model to set-points of every joint. Controllers are plug-ins.

`controller`        what a controller is, and how one is written
`hold`, `path_following`, `obstacle_triplet`   the ones that are shipped
`body_on_path`, `progress`, `planar_body`, `bumpless`   what they share: a chain on a path, where it is along it, the
                    body that bends at its yaw joints, and changes of mode without a jump
`states`            the four states of the paper's Figure 6
"""
