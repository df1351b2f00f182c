"""The host's log of a run, on disk and in memory.

`black_box`     every tick: a ring in memory, and the format of the file
`writer`        writes it to disk while the host runs
`host_record`   the host's statistics, and the names of the files
"""
