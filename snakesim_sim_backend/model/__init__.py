"""Builds the MuJoCo model of a robot in its scene.

`build`      compiles the model, and finds the robot and the obstacles in MuJoCo's arrays
`ground`     adds a plane or hills
`friction`   gives geoms the coefficients of surfaces and links
`obstacles`  adds pegs, boxes, steps and what else stands in the scene
`surface`    contact parameters of everything that the robot may touch
`imu`        adds the IMUs of the links
`mjcf`       writes the model for other MuJoCo programs
`tether`     adds the rope of the static checks, and reads its tension
"""
