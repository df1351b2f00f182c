"""What ranging sensors measure: scans of upright surfaces.

`scan`        a scan, and how it is made of a lidar's ranges
`depth_scan`  a scan of a depth image; `ground` is the plane on which the robot lies
"""
