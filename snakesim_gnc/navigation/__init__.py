"""Navigation: path and speed of the snake, from a mission or an operator's intent.

`core`, `intents`           along a given route; speed and direction, and whose desired they are
`clutter`                   along a path of its own, planned again and again: `beam` searches, `margin` says whether a
                            body can push itself there, `snap` pulls the path to what it pushes off; `obstacle_map`
                            and `line` are their geometry
`service`                   the process
"""
