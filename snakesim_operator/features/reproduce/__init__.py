"""`snakesim reproduce`: published experiments in our simulator, with the published number, ours, and why they differ.

`arguments`       the arguments of the command; the only module here that is imported without the extra `report`
`command`         lists and runs experiments, and prints and writes what they found
`experiment`      what every experiment states and finds
`experiments`     a module for each experiment
`trials`          runs configurations in worker processes, and measures the motion
`gait_motion`     speed, joint angles and work against the ground, from the record of a run
`planar_chain`    the same chain without MuJoCo: momentum balance in the plane, for the reasons of differences
`endless_curve`   a body of endless length, in balance at any time, likewise
`comparison_text` what is printed
`picture`         a picture for each experiment

Imports `run` and `results`.
"""
