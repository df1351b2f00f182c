"""Feetech STS servos (STS3215, STS3250) on a half-duplex serial bus: the backend `feetech`.

The servos have no watchdog: one whose host dies holds its last goal with torque on. `settings` and `backend` refuse
real servos until the scenario accepts that. Facts come from the maker's SDK and from LeRobot's tables; where these
disagree, or say nothing, `registers` states what is assumed.
"""
