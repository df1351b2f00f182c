"""What people touch: the `snakesim` command, what a run leaves behind, and the report on it.

Backends, controllers and services are found through entry points, so this package imports the HAL only.
Start at `cli`; `run` is the supervisor of a run's processes.
"""
