"""Fuzzing of everything that decodes bytes of others, and of what a HAL does with what it decoded.

    python -m verification.fuzz --payloads 1000000 [--seed 1]

Every payload is made from a valid one by one seeded mutation. A decoder refuses with its own error and nothing else, in
few words and little time whatever the sender wrote, and memory does not grow.

payloads, run    messages on the wire: samples, queries, answers
texts, inputs    motion-capture datagrams; flags and faults as typed; files: robot, scene, scenario, configuration, the
                 emergency stop's, the note of the last run, everything in a run's folder
bus              frames on a CAN bus, for the driver and for the modules
network          a robot that runs, and a stranger on its network
"""
