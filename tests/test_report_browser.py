"""The report in a browser without a network: it draws, its sliders move, and it fits a phone, the dark and paper."""

from __future__ import annotations

import base64
import shutil
import time
from itertools import pairwise
from pathlib import Path

import pytest
from small import small_trainer

from pirl_rl.reports import write_report

pytestmark = pytest.mark.slow

webdriver = pytest.importorskip("selenium.webdriver", reason="selenium, of the extra `browser`, is not installed")
keys = pytest.importorskip("selenium.webdriver.common.keys").Keys
service = pytest.importorskip("selenium.webdriver.chrome.service").Service
wait = pytest.importorskip("selenium.webdriver.support.ui").WebDriverWait

DATA = Path(__file__).parent / "data"
FLAGS = ("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync")
FLAGS += ("--disable-background-networking", "--disable-component-update", "--window-size=1280,900")
OFFLINE = {"offline": True, "latency": 0, "downloadThroughput": 0, "uploadThroughput": 0}
STEPS = ("env.dt=0.1", "env.substeps=1", "evaluation.final=[success]")
PROBLEMS = ("reach1d", "dubins", "quadrotor", "drift")


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    """A headless Chromium that cannot reach any network."""
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    driver = shutil.which("chromedriver")
    if not (chromium and driver):
        pytest.skip("no Chromium with its driver is installed; on Debian: apt-get install chromium chromium-driver")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for flag in (*FLAGS, f"--user-data-dir={tmp_path_factory.mktemp('chromium')}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    browser = webdriver.Chrome(options=options, service=service(driver))
    browser.execute_cdp_cmd("Network.enable", {})
    browser.execute_cdp_cmd("Network.emulateNetworkConditions", OFFLINE)
    yield browser
    browser.quit()


@pytest.fixture(scope="module")
def pages(tmp_path_factory) -> dict[str, Path]:
    """A report of each problem: two runs of an earlier version, and two whose networks were not trained."""
    folder = tmp_path_factory.mktemp("pages")
    runs = {"reach1d": DATA / "format1", "drift": DATA / "format1_drift"}
    for name in ("dubins", "quadrotor"):
        runs[name] = folder / name
        small_trainer(runs[name], base=(f"+experiment={name}", "+debug=default", *STEPS)).save()
    pages = {name: write_report([run], folder / f"{name}.html") for name, run in runs.items()}
    return pages | {"both": write_report([runs["reach1d"], runs["dubins"]], folder / "both.html")}


def opened(browser, page: Path, width: int = 1280, scheme: str = "light"):
    """Open a page in a window of a width and a colour scheme, and wait until it is drawn."""
    size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 500}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    wanted = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", wanted)
    browser.get(page.as_uri())
    wait(browser, 60).until(lambda one: one.execute_script("return document.body.dataset.ready"))


def picture(browser, selector: str) -> str:
    return browser.execute_script("return document.querySelector(arguments[0]).innerHTML", selector)


@pytest.mark.parametrize("name", [*PROBLEMS, "both"])
def test_a_page_draws_without_a_network_or_an_error(name, browser, pages):
    opened(browser, pages[name])
    charts = browser.execute_script("return [...document.querySelectorAll('.chart')].map((e) => e.innerHTML.length)")
    assert min(charts) > 1_000
    places = "[...document.querySelectorAll('.map-value, .map-control')]"
    maps = browser.execute_script(f"return {places}.map((e) => e.querySelectorAll('image').length)")
    assert maps
    assert all(maps)
    assert browser.execute_script("return performance.getEntriesByType('resource').length") == 0
    assert browser.get_log("browser") == []


@pytest.mark.parametrize("name", PROBLEMS)
def test_every_slider_changes_the_picture_by_the_keyboard(name, browser, pages):
    opened(browser, pages[name])
    sliders = browser.find_elements("css selector", "input[type=range]")
    assert len(sliders) == {"reach1d": 1, "dubins": 2, "quadrotor": 5, "drift": 6}[name]
    for slider in sliders:
        before, told = picture(browser, ".map-value"), slider.get_attribute("aria-valuetext")
        slider.send_keys(keys.ARROW_LEFT * 2)
        wait(browser, 20).until(lambda one, before=before: picture(one, ".map-value") != before)
        assert slider.get_attribute("aria-valuetext") != told
        label = browser.execute_script("return arguments[0].labels[0].textContent", slider)
        assert label.strip()
    assert browser.get_log("browser") == []


def test_planes_controls_and_paths_can_be_chosen(browser, pages):
    opened(browser, pages["quadrotor"])
    for selector, chart in ((".plane", ".map-value"), (".component", ".map-control")):
        before = picture(browser, chart)
        browser.find_element("css selector", selector).send_keys(keys.ARROW_DOWN)
        wait(browser, 20).until(lambda one, chart=chart, before=before: picture(one, chart) != before)
    before = picture(browser, ".map-value")
    browser.find_element("css selector", ".with-paths").send_keys(keys.SPACE)
    wait(browser, 20).until(lambda one: len(picture(one, ".map-value")) < len(before))
    assert browser.get_log("browser") == []


def test_the_slider_of_tau_runs_by_itself_and_stops(browser, pages):
    opened(browser, pages["dubins"])
    button = browser.find_element("css selector", ".play")
    button.send_keys(keys.ENTER)
    most = browser.execute_script("return Number(document.querySelector('.tau').max)")
    value = "return Number(document.querySelector('.tau').value)"
    wait(browser, 20, 0.05).until(lambda one: one.execute_script(value) < most)
    button.send_keys(keys.ENTER)
    stopped = browser.execute_script(value)
    assert button.text == "Play from T to 0"
    assert 0 < stopped < most
    time.sleep(0.6)  # more than two of its steps
    assert browser.execute_script(value) == stopped


@pytest.mark.parametrize("name", [*PROBLEMS, "both"])
def test_a_phone_scrolls_in_one_direction_alone(name, browser, pages):
    opened(browser, pages[name], width=360)
    browser.execute_script("document.querySelectorAll('details').forEach((part) => { part.open = true; })")
    assert browser.execute_script("return document.documentElement.scrollWidth") <= 360
    wide = "return [...document.querySelectorAll('.chart')].filter((e) => e.getBoundingClientRect().right > 360).length"
    assert browser.execute_script(wide) == 0


def brightness(browser, script: str) -> float:
    """The mean of the three colours that a script returns as rgb(...)."""
    colours = browser.execute_script(f"return {script}").partition("(")[2].rstrip(")").split(",")[:3]
    return sum(map(float, colours)) / 3


GROUND = "getComputedStyle(document.body).backgroundColor"
LETTERS = "getComputedStyle(document.querySelector('.chart .xtick text')).fill"


def test_the_dark_is_dark_and_paper_is_white(browser, pages):
    opened(browser, pages["dubins"], scheme="dark")
    assert brightness(browser, GROUND) < 60
    assert brightness(browser, LETTERS) > 180
    browser.execute_script("dispatchEvent(new Event('beforeprint'))")
    assert brightness(browser, LETTERS) < 80
    browser.execute_script("dispatchEvent(new Event('afterprint'))")
    assert brightness(browser, LETTERS) > 180
    printed = base64.b64decode(browser.execute_cdp_cmd("Page.printToPDF", {"printBackground": True})["data"])
    assert printed.startswith(b"%PDF")
    assert printed.count(b"/Type /Page\n") > 3
    opened(browser, pages["dubins"])
    assert brightness(browser, GROUND) > 200
    assert brightness(browser, LETTERS) < 80


def test_the_keyboard_comes_to_the_contents_first(browser, pages):
    opened(browser, pages["reach1d"])
    browser.find_element("css selector", "body").send_keys(keys.TAB)
    assert browser.execute_script("return document.activeElement.getAttribute('href')") == "#verdict"
    headings = browser.execute_script("return [...document.querySelectorAll('h1,h2,h3,h4')].map((e) => e.tagName)")
    levels = [int(tag[1]) for tag in headings]
    assert levels[0] == 1
    assert levels.count(1) == 1
    assert all(after <= before + 1 for before, after in pairwise(levels))
    bare = "img:not([alt]), [role=img]:not([aria-label]):not([aria-labelledby])"
    assert browser.find_elements("css selector", bare) == []
