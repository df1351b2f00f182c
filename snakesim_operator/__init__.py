"""What people touch: the `snakesim` command.

From the ground up:

`results`   what a run leaves behind, read back: record, summary, report, compare
`tools`     commands on robots that are there: status, echo, arm, estop, fault; and schemas, completion
`run`       `snakesim run`: starts, watches and ends a run's processes
`cli`       the command line; start reading here

Backends, controllers and services are found through entry points, so this package imports the HAL only.
"""
