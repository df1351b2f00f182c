"""Navigation: path and speed of the snake, from a mission or an operator's intent."""
