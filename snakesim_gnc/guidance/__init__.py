"""Guidance: makes a world model of contacts and pose for the other services."""
