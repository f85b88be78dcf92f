"""The page in a real Chromium: no message, no request, nothing hostile runs, and what is to be pressed answers."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

playwright = pytest.importorskip("playwright.sync_api")

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
SECTIONS = ("frames", "strips", "attempts", "figures", "findings", "settings")


@pytest.fixture(scope="module")
def browser() -> Iterator[object]:
    """An installed Chromium without window."""
    path = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if path is None:
        pytest.skip("no Chromium is installed")
    with playwright.sync_playwright() as driver:
        # In containers there is no sandbox for root; the page is ours, and has no network.
        browser = driver.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield browser
        browser.close()


class Opened:
    """A page that was opened, with everything that it said and asked for."""

    def __init__(self, browser, path: Path, scheme: str = "light") -> None:
        self.context = browser.new_context(color_scheme=scheme, viewport={"width": 1280, "height": 900})
        self.tab = self.context.new_page()
        self.messages: list[str] = []
        self.requests: list[str] = []
        self.tab.on("console", lambda message: self.messages.append(message.text))
        self.tab.on("pageerror", lambda error: self.messages.append(str(error)))
        self.tab.on("dialog", lambda dialog: self.messages.append(dialog.message))
        self.tab.on("request", lambda request: self.requests.append(request.url))
        self.tab.add_init_script("addEventListener('securitypolicyviolation', event => console.log(event.violatedDirective))")
        self.tab.goto(path.as_uri())

    def scroll(self) -> None:
        """Show every section, until its plots are drawn."""
        for name in SECTIONS:
            self.tab.evaluate("name => document.getElementById(name).scrollIntoView({behavior: 'instant'})", name)
            self.tab.wait_for_timeout(50)
        for plot in self.tab.query_selector_all("#figures .plot"):
            plot.scroll_into_view_if_needed()
        self.tab.wait_for_function(
            "document.querySelectorAll('#figures .plot svg').length === document.querySelectorAll('#figures .plot').length"
        )

    def text(self, selector: str) -> str:
        return self.tab.text_content(selector) or ""


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_all_sections_are_drawn_without_message_or_request(browser, page, scheme):
    opened = Opened(browser, page, scheme)
    opened.scroll()
    assert opened.messages == []
    assert [url for url in opened.requests if not url.startswith("data:")] == [page.as_uri()]
    assert opened.tab.evaluate("performance.getEntriesByName('first-contentful-paint').length") == 1
    assert opened.tab.evaluate("[...document.querySelectorAll('img[src]')].every(image => !image.complete || image.naturalWidth > 0)")
    assert len(opened.tab.query_selector_all("#frames .stage")) == 12
    dark = opened.tab.evaluate("getComputedStyle(document.body).backgroundColor")
    assert (dark == "rgb(20, 23, 26)") is (scheme == "dark")
    opened.tab.click("#theme")
    assert opened.tab.evaluate("getComputedStyle(document.body).backgroundColor") != dark
    opened.context.close()


def test_masks_boxes_and_depth_are_switched(browser, page):
    opened = Opened(browser, page)
    opened.tab.wait_for_selector("#frames .stage img[src]")
    painted = "canvas => canvas.width > 1 && canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data.some(v => v)"
    canvas = opened.tab.query_selector("#frames .stage canvas")
    assert opened.tab.query_selector("#frames .stage rect") is None
    opened.tab.keyboard.press("b")
    opened.tab.wait_for_selector("#frames .stage rect", state="attached")
    opened.tab.keyboard.press("m")
    opened.tab.wait_for_function(painted, arg=canvas)
    opened.tab.keyboard.press("m")
    opened.tab.wait_for_function(f"canvas => !({painted})(canvas)", arg=canvas)
    opened.tab.keyboard.press("a")
    opened.tab.wait_for_function(painted, arg=canvas)
    opened.tab.keyboard.press("a")
    opened.tab.wait_for_function(f"canvas => !({painted})(canvas)", arg=canvas)
    before = opened.tab.get_attribute("#frames .stage img", "src")
    opened.tab.click("#frames button:has-text('depth')")
    assert opened.tab.get_attribute("#frames .stage img", "src") != before
    assert "(red) to" in opened.text("#frames .shown")
    opened.tab.click("#frames .stage")
    opened.tab.wait_for_selector("dialog[open] .stage")
    opened.tab.keyboard.press("ArrowRight")
    assert opened.text("dialog .hint").startswith("2 of 12")
    opened.tab.keyboard.press("Escape")
    assert opened.messages == []
    opened.context.close()


def test_the_film_strip_follows_the_keyboard(browser, page):
    opened = Opened(browser, page)
    opened.tab.evaluate("document.getElementById('strips').scrollIntoView({behavior: 'instant'})")
    opened.tab.wait_for_selector(".scrub input")
    assert opened.text(".scrub output").startswith("frame 0 of 2")
    opened.tab.focus(".scrub input")
    opened.tab.keyboard.press("ArrowRight")
    assert opened.text(".scrub output").startswith("frame 1 of 2")
    assert len(opened.tab.query_selector_all(".cameras canvas")) == 3
    opened.tab.evaluate("document.getElementById('attempts').scrollIntoView({behavior: 'instant'})")
    opened.tab.wait_for_selector("#attempts .graph")
    assert "the target hung" in opened.text("#attempts .verdict").lower()
    assert opened.messages == []
    opened.context.close()


def test_nothing_hostile_runs(browser, hostile_page):
    opened = Opened(browser, hostile_page)
    opened.scroll()
    opened.tab.hover("#frames .stage")
    opened.tab.keyboard.press("b")
    for plot in opened.tab.query_selector_all("#figures .plot svg .mark-rect path, #figures .plot svg path[aria-roledescription]")[:5]:
        plot.hover(force=True)
    assert opened.tab.evaluate("window.ran") is None
    assert opened.messages == []
    assert [url for url in opened.requests if not url.startswith("data:")] == [hostile_page.as_uri()]
    assert len(opened.tab.query_selector_all("main img[onerror], main script")) == 0
    opened.context.close()
