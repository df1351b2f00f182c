"""How each row of the fault table is measured."""
