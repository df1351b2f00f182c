"""What every driver of real joints needs besides its protocol.

Start at `mounting.py`, which converts between a joint and the shaft of its drive. Pure: no bus, no clock.
"""
