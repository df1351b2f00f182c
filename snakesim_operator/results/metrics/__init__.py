"""Metrics that are computed from the record of a run.

`advance`         progress towards the goal, energy     `motion`       when the body moved, as measured
`effort`          what the advance cost                 `propulsion`   which joint propelled when
`estimates`       dead reckoning against measurement    `form_closure` whether obstacles hold the body
`force_tracking`  measured against desired forces       `map_score`    a perceived map against the truth
"""
