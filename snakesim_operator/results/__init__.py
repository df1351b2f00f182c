"""The results of a run.

`record`    a run's folder, or a recording (`recorded`), as arrays     `summary`   its numbers
`gaps`      missing data, as text                           `report`, `compare`   the pages made of it
`last_run`  folder of the user's last run
"""
