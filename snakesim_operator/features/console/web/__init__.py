"""The page server of the console: serves pages, and decides which messages of browsers viser gets to read.

    browser -> front server (another process) -> `page_server` -> viser's own server (`viser_server`)

- `serve`: starts both servers of this process.
- `page_server`: answers requests for pages, and relays the messages between each browser and viser.
- `browser`, `admission`, `message_age`: which messages of a browser are relayed, and which are handled here.
- `pacing`: sends a page no more than it can show.
- `added_html`: what is added to viser's page.
"""
