"""`snakesim robot`: robot files from URDF, and URDF from robot files.

`importing.import_urdf` turns a URDF into the values of a robot file, `exporting.format_urdf` writes one; `command` is
what the command line calls. What the other format has no words for is reported, never dropped in silence.
Pure files in, files out: nothing here imports a backend or the network.
"""
