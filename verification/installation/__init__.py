"""Installed from wheels, with and without extras."""
