"""Control: from trajectory and world model to set-points of every joint. Controllers are plug-ins.

`controller`        what a controller is, and how one is written
`hold`, `path_following`, `obstacle_triplet`   the ones that are shipped
`states`            the four states of the paper's Figure 6
"""
