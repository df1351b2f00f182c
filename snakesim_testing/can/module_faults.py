"""Lists the faults of joint modules that tests inject."""

# Each row has the injected fault, the driver's name for it, and the maximum number of periods until it is detected.
MODULE_FAULTS = [
    ("mute", "module_silent", 4),
    ("freeze", "module_frozen", 5),
    ("reboot", "module_restarted", 14),
    ("counter", "wrong_counter", 4),
    ("checksum", "bad_checksum", 4),
    ("duplicate", "duplicate_node", 4),
    ("overheat", "module_overheat", 3),
    ("leak", "module_leak", 3),
    ("undervoltage", "module_voltage", 3),
    ("babble", "module_babbling", 3),
]
