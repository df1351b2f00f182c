"""Commissioning: finds out how a robot's joints are mounted and what they are, and writes it into its file.

By hand, or with one joint at a time:

`by_hand`      zero, direction, gear and limits of each joint, while a person moves the robot
`capture`      what these motions mean; pure
`jog`          moves one joint by its motor while a key is held
`robot_edit`   changes single values of a robot file

With drawn shapes:

`shape`        the person bends the robot into shapes on paper, which decide sign, order, gear and zero of every joint

From recorded runs:

`joint_check`            a run in which each joint moved by its motor shows whether the joints match the robot file
`system_identification`  a run in which a suspended robot was shaken shows what its joints are
"""
