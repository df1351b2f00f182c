"""CAN frames, joint modules and drivers on buses for tests."""
