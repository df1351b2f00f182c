"""What the console knows of a robot at one instant: from the network, or from a recording."""
