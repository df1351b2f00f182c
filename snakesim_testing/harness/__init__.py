"""What every suite needs to drive real processes and networks. Knows nothing of ours: the attacks use it too."""
