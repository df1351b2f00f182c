"""One digest on every computer."""
