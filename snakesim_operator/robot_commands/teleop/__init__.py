"""`snakesim teleop`: drive a robot from the keyboard or with a joystick, through intents that expire.

`steering` computes what is requested, without I/O; `keyboard` and `joystick` are the inputs; `command` is the loop.
Whatever ends it, `kill -9` or a lost network too, ends the motion: navigation stops a robot that gets no requests.
"""
