"""The processes of a run: starting, supervising and ending them.

`supervisor`       starts the processes of a run in order, restarts them, and ends them all
`children`         starts single child processes; none outlives this one
`guarded_process`, `pinned_process`   a run or a function in a child process of its own
`console_child`, `console_front`      the processes of a run's console
`process_faults`   injects faults that need the supervisor, such as kills
`processor_waits`  measures how long processes wait for a processor
"""
