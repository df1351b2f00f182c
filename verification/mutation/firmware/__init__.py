"""Faults in the C firmware of a joint module, each of which a test must find.

    python -m verification.mutation.firmware                    planted faults, with a table of what finds each
    python -m verification.mutation.firmware no_watchdog ...    only these planted faults
    python -m verification.mutation.firmware --small-changes [FILE.c ...]

A planted fault breaks one promise of the specification in a way that a person could: a missing watchdog, an ignored
limit. `planted_faults.py` lists them. Each one is compiled, and then the firmware tests and the contract suite run
against it, with real processes. The command prints the first test of each that fails.

A small change is made by a script: one operator, one number, one condition or one statement. For these, only the quick
tests run: those that compare the firmware with its emulator on random traffic, and those of its promises to the board.
`equivalent.toml` lists the changes that have no effect, with the reason.

The faulty firmware exists only in a temporary folder. The working tree is never changed.
"""
