"""The robot's sensors, with the noise, rate and delay of its file.

`suite`      Sensors: every sensor of the robot, tick by tick; `timing` when each is due, and its delay
`registry`   which reader makes which message; `scope` what a reader gets
`joints`, `contacts`, `imu`, `pose`, `power`   read within the tick
`depth`, `ranges`, `rendered`, `recorded`   look around: `snapshots` runs them in a thread of its own, on a copy of the
             state, so that they never delay a tick; `mount` is where they sit, `rays` what they cast

All values are read after the last physics step. Angles, speeds, places and the pose are those of the tick itself;
forces, torques and accelerations are those of the step that led to it.
"""
