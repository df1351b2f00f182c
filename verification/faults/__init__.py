"""The fault table: inject, measure, assert, and write it down.

`make faults`, or `python -m verification.faults --rows NAME`.

`table.py` names every row; `rows_*.py` measure them; `robot.py` is a robot's processes with an observer beside them.
Raw results go into docs/benchmarks/faults.json as each row ends, so that single rows can be run again. The table,
docs/fault-table.csv, and its summary, docs/benchmarks/faults.md, are made from them. A row that is not met does not
stop the others.
"""
