"""Measures each row of the fault table. The modules are grouped by the part that fails."""
