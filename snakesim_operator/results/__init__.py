"""What a run leaves behind, read back.

`record`    a run's folder as arrays     `summary`   its numbers     `gaps`   what is not known, in words
`report`, `compare`   the pages made of it     `last_run`   where the last run of this user stands
"""
