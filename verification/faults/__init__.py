"""The fault table: inject each fault into a running robot, measure the reaction, and judge it.

Run all rows with `make faults`, or some of them with `python -m verification.faults --rows NAME`.

`table` declares every row, and the modules in `rows` measure them. A measurement starts the processes of a robot
(`robot.py`) and an observer on its network (`observer.py`).

The result of each row is written to docs/benchmarks/faults.json as soon as the row ends, so you can measure single rows
again. `page.py` writes docs/benchmarks/fault-table.csv and its summary, docs/benchmarks/faults.md, from all results. A
row that is not met does not stop the other rows.
"""
