"""A lab: one file lists the machines, robots, routers and roles, and everything else is made from it.

`lab_file` and `lab_robot` read it; `drive_buses` knows what each drive type needs; `identities` names who has a
certificate; `certificates` makes those; `access` and `zenoh_files` write what Zenoh reads; `units` what systemd and
containers read; `render` all of it; `check` asks the live lab.
`cryptography`, of the extra `lab`, is imported in `certificates` and `check` alone.
"""
