"""Run records, browsers and console viewers for tests of the operator package."""
