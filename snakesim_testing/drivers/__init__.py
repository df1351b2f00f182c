"""Drivers and emulated drives, one tick after the other."""
