"""The panel beside the scene: header, tabs, charts, and the controls of each viewer."""
