"""Commissioning: finds out how a robot's joints are mounted and what they are, and writes it into its file.

By hand, or with one joint at a time:

`by_hand`      zero, direction, gear and limits of each joint, while a person moves the robot
`capture`      what these motions mean; pure
`jog`          moves one joint by its motor while a key is held
`robot_edit`   changes single values of a robot file

With drawn shapes:

`shape`        the person bends the robot into shapes on paper, which decide sign, order, gear and zero of every joint

Joint check, from a run in which each joint moved by its motor:

`check`        prints whether each joint matches its file, and records the check in that file
`measured`     collects the measurements of that run
`judge`        judges which properties of each joint are confirmed, wrong or unknown; pure
`link_shares`  how far links turned with a joint, and whose module is in whose place; pure
`lost_motion`  backlash; pure

System identification, from a run in which the controller `identify` shook a suspended robot:

`identify`        prints, draws (`identified_page`) and writes what was identified
`identification`  identifies all joints; pure
`torque_balance`  friction, rotor inertia and torque constant of a joint; pure
`servo_response`  stiffness, damping, response time and latency of a joint; pure
`suspended_load`  the torque that the links need; `followed_links`: whether they move as the encoders measure; pure
`least_squares`   values with 95 % intervals; `smoothing`: derivatives of noisy signals; pure
"""
