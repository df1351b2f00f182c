"""The campaign: tests that take hours or need a quiet machine. `make verify` runs them nightly and before a release.

`attack`        attacks of an unauthorized client on the robot's network
`faults`        measures the reaction to every fault, and writes the fault table
`fuzz`          sends damaged payloads into every decoder, and over the network
`soak`          long runs with random faults, and processes that are killed at random
`links`         bad network links between machines; needs root
`mutation`      changes to the safety core that a unit test must detect
`computers`     digests of runs with the instructions of other processors
`installation`  wheels, extras, and installations without some packages
`documents`     runs every command that the documentation prints
`sysid`         compares the system identification with `mujoco.sysid`
`ground`        measures robots on other grounds: slopes, fluids, wheels
"""

import snakesim_testing.isolation  # noqa: F401 - first: it fixes the arithmetic before NumPy is imported

# Options of pytest for tools that run the tests of a change. Without them, pytest leaves out the heavy tests.
TESTS_OF_A_CHANGE = ("-m", "not (slow or quiet)")
