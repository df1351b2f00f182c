"""The console: a robot in the browser, live or from a recording. Needs the extra `console` (viser).

`command` has the entry points, and `display_loop` the loop that takes one snapshot a frame and hands it to the page.

- `robot_data`: snapshots of a robot, from the network (`live_robot`) or from a recording (`run_playback`), and every
  number over time (`signals`).
- `scene`: what is drawn of a snapshot (`drawing`, without any I/O), and the nodes of viser that show it.
- `page`: the panel beside the scene, with texts and charts for all viewers and the controls of each viewer.
- `web`: serves pages (`page_server`), and checks what browsers send (`admission`).
- `front`: a process of its own, to which browsers connect. It has the second stop, and passes all other requests on.

`operations` sends a viewer's commands to the robot, and `control_token` decides which viewer has control.

The console is a client of the robot like any other: nothing in the robot waits for it.

Threads:

- The display loop is the main thread. It decodes messages, and shows snapshots.
- Zenoh's threads store messages (`live_robot`).
- The page server's event loop receives the messages of browsers. `admission` checks them there, and calls the handlers
  of the stop and of held buttons and keys. These must not wait.
- viser's event loop receives the messages that are admitted.
- viser's threads run the callbacks of all other controls, which may wait for the robot.
"""
