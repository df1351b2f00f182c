"""The results of a run.

`record`              loads a run's folder, or a recording (`recording_contents`), as arrays
`missing_data`        describes what a record does not hold, and sets the exit code of a command
`time_axis`           seconds since the first tick, and what control reported on that axis
`run_ending`          how a run ended
`metrics/`, `summary` the numbers of a run
`page/`               charts and templates that all pages share
`report/`, `compare/` the pages
`last_run`            the folder of the user's last run
"""
