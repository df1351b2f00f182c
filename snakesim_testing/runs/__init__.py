"""The `snakesim` command and whole runs, in processes or in one."""
