"""What the console adds to viser's page: the second stop, and scripts and styles for which viser has no option."""

from pathlib import Path

# The script stores a cookie, which the browser sends as it connects: viser's page has no message for this.
DARK_COOKIE = "snakesim-dark=true"
DARK_COOKIE_SCRIPT = (
    b'<script>document.cookie = "snakesim-dark=" + matchMedia("(prefers-color-scheme: dark)").matches'
    b' + "; path=/; SameSite=Strict"</script>'
)
SECOND_STOP = Path(__file__).with_name("second_stop.html").read_bytes()
STICKY_HEADER_STYLE = (  # of `page_html.format_header`: what is below is scrolled behind it
    b"<style>div:has(> [data-robot]) {position: sticky; top: 0; z-index: 5; background: var(--mantine-color-body);"
    b" padding-top: 2px} div:has(> div > div > div > [data-robot]) {overflow: clip !important; min-width: 0}"
    b' @media (max-width: 480px) {div[style*="width: 20em"] {width: 100% !important}}</style>'  # a phone's panel
)
TABS_IN_ONE_LINE_STYLE = (  # on a phone they wrap; viser's tabs have no class, but a style of their own
    b"<style>@media (min-width: 481px) {"
    b'div[style*="background-size: 100% 2.4em"] {flex-wrap: nowrap !important; overflow-x: auto !important}'
    b' div[style*="padding: 0px 0.9em"][style*="max-width: 14em"] {padding: 0 0.3em !important; flex-shrink: 0}'
    b"}</style>"
)
# Releases a held button when its page loses the keyboard, or is hidden: the finger may come up elsewhere.
RELEASE_HELD_BUTTON_SCRIPT = b"""<script>(() => {
  let held = null;
  addEventListener("pointerdown", event => { held = event.target; }, true);
  const end = () => { held?.dispatchEvent(new PointerEvent("pointercancel", {bubbles: true})); held = null; };
  addEventListener("blur", end);
  addEventListener("pagehide", end);
  document.addEventListener("visibilitychange", () => { if (document.hidden) end(); });
})()</script>"""


def add_html(page: bytes, *, has_stop: bool) -> bytes:
    """Return viser's page with HTML added before all else, where no script of viser can keep it from running.

    Args:
        page: The page as viser serves it.
        has_stop: Whether there is a robot that can be stopped.
    """
    added = DARK_COOKIE_SCRIPT + STICKY_HEADER_STYLE + TABS_IN_ONE_LINE_STYLE
    if has_stop:
        added = SECOND_STOP + RELEASE_HELD_BUTTON_SCRIPT + added
    before, head, after = page.partition(b"<head>")
    if not head:
        return added + page
    return before + head + added + after
