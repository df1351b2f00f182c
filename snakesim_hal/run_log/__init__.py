"""What is left of a host's run, on disk and in memory.

`black_box`    every tick: a ring in memory, and the file's format      `recorder`   writes it while the host runs
`host_record`  the host's own numbers, and the names of the files
"""
