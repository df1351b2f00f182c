"""System identification, from a run in which the controller `identify` shook a suspended robot.

`identify`         prints, draws (`identified_page`) and writes what was identified
`identification`   identifies all joints
`torque_balance`   friction, rotor inertia and torque constant of a joint
`servo_response`   stiffness, damping, response time and latency of a joint
`suspended_load`   the torques that the links need
`followed_links`   whether the links move as the encoders measure
`least_squares`    values with 95 % intervals; `smoothing`: derivatives of noisy signals
"""
