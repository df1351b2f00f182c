"""`snakesim run`: a run's processes from start to end.

`arguments`     the commands
`run`           the whole run, with processes; `in_process` without processes or a network, also for programs
`processes`     starts, supervises and ends the processes
`run_endpoint`  chooses the endpoint of the run, and opens its stop port
`monitor`       monitors the run, arms it, and notices faults; with `progress`, `arming_timeout` and `ending`
`folder`, `run_files`, `conclusion`   the files of a run, and the output at the end
`host`          the HAL host alone
"""
