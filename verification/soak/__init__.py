"""A long run in which things go wrong at random, and a person gets it going again each time.

    python -m verification.soak --minutes 30 [--seed 1] [--backend can]

One `snakesim run --stay` in real time. Faults come from the product's own injector; after each, the robot must say what
happened, an operator's commands must bring it back, and memory, threads, files and processes must be as before.
"""
