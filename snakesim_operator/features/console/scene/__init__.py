"""The 3-D scene: from a snapshot to shapes in world coordinates, and from these to viser's nodes."""
