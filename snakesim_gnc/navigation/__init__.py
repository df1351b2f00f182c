"""Navigation: where the snake shall go and how fast, from a mission or from somebody's intent."""
