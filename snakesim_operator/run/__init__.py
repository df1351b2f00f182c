"""`snakesim run`: a run's processes from start to end.

`run`        the command         `meeting`    reserves the endpoint, refuses a second robot of that name
`in_process` the same without processes and network, also for programs; `pinned_process` for those with NumPy loaded
`supervisor`, `children`         start and restart processes; none outlives this one
`monitor`    monitors the run, arms it, ends it; with `progress`, `process_faults`, `processor_waits`, `ending`
`folder`, `run_files`, `conclusion`   the files written, and the output at the end
"""
