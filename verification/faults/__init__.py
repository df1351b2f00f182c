"""The fault table: inject, measure, assert, and write it down.

`make faults`, or `python -m verification.faults --rows NAME`.

`table` names every row, and the modules in `rows` measure them. `robot.py` starts the processes of a robot, and an
observer beside them.
Raw results go into docs/benchmarks/faults.json as each row ends, so that single rows can be run again. The table,
docs/benchmarks/fault-table.csv, and its summary, docs/benchmarks/faults.md, are made from them. A row that is not met
does not stop the others.
"""
