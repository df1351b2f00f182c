"""Long runs in which random faults occur, and in which random processes are killed.

    python -m verification.soak --minutes 30 [--seed 1] [--backend can]
    python -m verification.soak.kills --trials 300 [--seed 1] [--backend can]

A soak is one `snakesim run --stay` in real time. Its faults come from the product's own injector. After each fault, the
robot must report what happened, the commands of an operator must recover it, and memory, threads, files and processes
must be as before (faults, watch, health).

In kills, each trial is a run of its own (kills, killed_run).
"""
