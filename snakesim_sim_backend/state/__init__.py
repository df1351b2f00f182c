"""Sets and reads the state of a simulation.

`start`       puts the snake on the ground and lets it come to rest
`contacts`    contacts of the links with obstacles
`loads`       the sum of the contacts of each link, as force sensors measure it
`truth`       the exact state, for tests and reports
`divergence`  detects a simulation that has diverged
"""
