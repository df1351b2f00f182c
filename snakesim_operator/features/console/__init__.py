"""The console: a robot in the browser, live or from a recording. Needs the extra `console` (viser).

`command` has the entry points, `display_loop` the loop: it takes one snapshot a frame and hands it to the page.

- `robot_data`: snapshots of a robot, from the network (`live_robot`) or from a recording (`recorded_run`), and every
  number over time (`signals`).
- `scene`: what is drawn of a snapshot (`drawing`, without any I/O), and the nodes of viser that show it.
- `page`: the panel beside the scene, with texts and charts for all viewers and the controls of each viewer.
- `web`: accepts connections and has the second stop (`connection_acceptor`), serves pages behind it (`server`), and
  checks what browsers send (`admission`).

`operations` sends a viewer's commands to the robot, and `control_token` decides which viewer has control.

The console is a client of the robot like any other: nothing in the robot waits for it.
"""
