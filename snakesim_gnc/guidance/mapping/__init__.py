"""A map of obstacles that begins empty.

`obstacle_map`  obstacles from scans, touches and the body's own path, with `clusters` of a scan
`tracks`        one obstacle: its `surfaces`, its shape by `circle_fit` or `box_fit`, and the evidence that it exists
"""
