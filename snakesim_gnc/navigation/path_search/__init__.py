"""The search for a path ahead of the head, or for the whole body.

`beam`               begins a search, and returns its path; explains the cost
`specified_growth`   makes the paths one arc longer: the specification, with NumPy
`native_growth`      does the same in C, with the data and functions of `native_library`
`search_task`        what is searched, and what is found
`search_parameters`  the robot, the costs, and the sizes of the search
`search_arcs`        the arcs by which a path grows
`search_nodes`       the ends of paths, with the contacts that the body would have
`body_contacts`      what the body touches on a path
`margin`             how hard a body can push itself with the contacts that it has
"""
