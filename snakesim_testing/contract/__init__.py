"""The contract of a backend as tests: run them on a backend of your own with one command.

    python -m pytest -p snakesim_testing --pyargs snakesim_testing.contract --snakesim-backend NAME_or_./file.py:Class

`plugin`      the pytest plugin: options, fixtures and the table at the end
`bench`       one backend with its settings, opened by one user at a time
`rig`         an open backend, driven tick by tick through the real limiter
`faults`      injects faults into the emulated drives of a backend
`kit_drives`  what emulated drives on the driver kit do, and their own log
`loopback`    the same behind the real host, with a real client
`tolerances`  all tolerances of the tests, with their reasons
`test_*`      the clauses

pytest is imported in `plugin` and `test_*` only; the rest of the HAL imports nothing from here.
"""
