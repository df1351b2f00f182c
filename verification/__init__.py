"""The campaign: what takes hours or a quiet machine. `make verify` runs it nightly and before a release.

`attack`        an unauthorized client on the robot's network, in full
`faults`        the fault table: every fault, measured
`fuzz`          damaged payloads into every decoder, and over the network
`soak`          long runs with random faults; random kills
`links`         bad links between machines; needs root
`mutation`      changes to the safety core that a unit test must detect
`computers`     the digests under the code of other processors
`installation`  wheels, extras, and packages that are left out
`documents`     every command that the documentation prints
"""

import snakesim_testing.isolation  # noqa: F401 - first: it fixes the arithmetic before NumPy is imported
