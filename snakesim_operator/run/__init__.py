"""`snakesim run`: a run's processes from start to end.

`run`        the command         `meeting`    a network of its own, and no second robot of that name
`in_process` the same without processes and network, also for programs
`supervisor`, `children`         start and restart processes, none outlives this one
`monitor`    watches the run, arms it, ends it; `telemetry`, `progress`, `process_faults`, `ending` beside it
`folder`, `run_files`, `conclusion`   what is written, and what is said at the end
"""
