"""The console: a robot in the browser, live or from a recording.

`snapshot` is what there is to show of one instant; `watch` takes it from the network, `recorded` from a run's folder,
with `heard` for what a record's rows do not have. `signals` is every number over time, live, `recorded_signals` of a
run; `signals_page` answers the page `signals.js` with them.
`drawing` turns it into poses, arrows and lines in the world, without any I/O. `stage` draws those with viser (shapes
from `meshes`), `page` and `charts` show the rest, `controls` has the buttons of one viewer. `token` decides who has
control. `port` is open at once, `front` accepts there and has the second stop, `server` serves pages behind it;
`admission` is what a `browser` may say to them. `console` is the loop around them, `command` the
entry points.

It is a client of the robot like any other: nothing of the robot waits for it. Needs the extra `console` (viser).
"""
