"""Small robots and scenes in the simulator."""
