"""Compares `snakesim robot identify` with `mujoco.sysid` on the same recordings of emulated drives.

    python -m verification.sysid --first 1000 --robots 20 [--backlash] [--results FILE]

Every robot hangs by its tail, and has hidden parameters, drawn by its number, which is its seed. `robot identify`
solves equations of each joint. `mujoco.sysid` simulates the whole record again and again, with the model of the
simulator, and fits all parameters of all joints at once. It gets the best case: the true noise of the sensors, the
values of the robot file as a start, and a model that is exactly that of the emulated drives. With `--backlash` one
joint of each robot has backlash, which neither method models. The other hidden parameters of a robot stay the same.

It needs the optional packages of `mujoco.sysid`:

    pip install "mujoco-core[sysid]"

estimates     the parameters, and the result of one method for one robot
equations     identifies a robot with `robot identify`
rollout_fit   identifies a robot with `mujoco.sysid`
comparison    runs all methods on one robot, and keeps their results in a file
tables        makes the tables of the errors, of the intervals, and of the robots that do not fit the model
"""
