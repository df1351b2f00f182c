"""Navigation: path and speed of the snake, from a mission or an operator's intent.

`service`           the process
`intents`           which intent is valid, and the speed and direction that follow from it
`known_path`        follows a given route
`clutter`           plans a path towards a goal, again and again, with bounded work in each update
`planning_goal`     where that goal is, and whether it is reached
`plan`              makes one plan: search, path fit, push-points
`path_search/`      searches a path
`path_fit`          fits a path to the obstacles that the body pushes off, and smooths it
`obstacle_grid`     finds the nearest obstacle of many points
`platform_rises`    where a path leads over platforms
"""
