"""`snakesim robot`: robot files from URDF, and URDF from robot files.

`importing.robot_of` turns a URDF into the values of a robot file, `exporting.urdf_of` writes one; `command` is what the
command line calls. What the other format has no words for is reported, never dropped in silence.
Pure files in, files out: nothing here imports a backend or the network.
"""
