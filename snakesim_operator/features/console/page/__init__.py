"""What stands on the page beside the scene: header, tabs, charts, and the controls of each viewer."""
