"""Many simulated robots at once, as rows of arrays, for environments to learn in.

`SimBackend` simulates one robot behind the HAL. Here the same models, laws, motors and sensors step any number of
robots, each in a scene of its own, with the same bits. Messages are left out: sensor values are arrays of shape
(robots, n).

`placed`        one robot at rest in its scene
`simulations`   the seam to MuJoCo: steps all simulations through one control period, in a loop
`batched`       the same on MuJoCo's `Batch`, by threads in C
`noise`         the random numbers of all robots
`samples`       rates and delays of sensors
`sensors`       what environments observe: joints, pose, contact forces, winding temperatures
`heat`          winding temperatures of all motors
`robots`        all of it together
"""
