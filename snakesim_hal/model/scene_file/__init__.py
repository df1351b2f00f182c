"""The scene file: the ground, the obstacles on it, and the route of the snake.

`scene`         the whole file
`solids`        what obstacles are made of
`friction`      friction that depends on the direction of sliding
`terrain`       ground that is not flat: `pipes`, stairs and `platforms`
`fluid`         the fluid in which the snake swims
`placement`     the obstacles at their places, with `random_field`
`randomization` values that differ from one episode to the next
`fitting`       scales a scene that was made for another robot
"""
