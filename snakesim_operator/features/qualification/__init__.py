"""`snakesim drive qualify`: the first hour with a real drive, and a signed record of what it has confirmed.

A qualification runs a list of steps on one clamped drive. Data flows in one direction:

    protocol/steps.py    what each step asks of the operator, and its criterion (pure)
    procedures.py        names the procedure of each step, which carries it out through the rig and returns checks:
                         values with bounds. They are in motion_procedures.py and stop_procedures.py
    protocol/checks.py   decides: confirmed, refuted or unknown (pure)
    protocol/record.py   the steps and claims with their verdicts; signature.py signs it, summary.py prints it

The rig (rig.py) has the normal HAL host, a commanding client, and a second program that reads the drive. The assistant
(assistant.py) is the person at the bench, or for emulated drives a program. runner.py goes through the steps.
"""
