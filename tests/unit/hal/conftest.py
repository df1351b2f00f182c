"""Hypothesis has no time limit per example here: these machines are shared, and a slow moment is no failure."""

from hypothesis import HealthCheck, settings

settings.register_profile("hal", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("hal")
