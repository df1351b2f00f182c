"""The results of a run.

`run_reader`          one interface to a run's folder and to a recording alone; `recording_contents` reads the messages
`run_log`             loads a run through it, as arrays
`run_ending`          describes how a run ended
`missing_data`        describes what is missing in a run log, and sets the exit code of a command
`time_axis`           seconds since the first tick, and what control reported on that axis
`metrics/`, `summary` the metrics of a run
`page/`               charts, drawings and templates that all pages share
`report/`, `compare/` the pages
`last_run`            the folder of the user's last run
"""
