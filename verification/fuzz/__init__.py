"""Fuzzing: invalid payloads into everything that decodes data from outside, and what follows from decoded ones.

    python -m verification.fuzz --payloads 1000000 [--seed 1]
    python -m verification.fuzz --payloads 1000000 --network

Each payload is made from a valid one by a random mutation; one seed gives the same payloads again. A decoder may raise
its own error with a short reason, and nothing else. It must be fast, and memory must not grow.

payloads, decoders     messages on the wire: samples, queries, answers
inputs, all_inputs     motion capture and the stop port (datagram_inputs); options, files that users write, files that
                       the product keeps, and files of a run (file_inputs); text_mutations makes their payloads
bus                    frames on a CAN bus, for the driver and for the joint modules
recordings             damaged recordings (recording_damages), for every command that reads one (forked_commands)
network                a running robot, and an unauthorized client (fuzz_client, effects), watched from outside
                       (run_watcher, vitals) and judged (network_verdict)
"""
