"""What every package uses. Imports nothing else of SnakeSIM.

`errors`         the one error tree
`terminal`       output to the terminal; text from files and networks cannot control it
`process`        child processes that end with their parent, and orderly shutdown on a signal
`atomic_write`   writes a file completely or not at all
`arrays`         names of array types
`workers`        threads that report an unexpected error and continue
`step_limit`     interrupts a step that takes too long
`arithmetic`     makes floating-point results the same on every processor
"""
