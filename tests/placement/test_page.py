"""The page of a design, in headless Chromium: its numbers are Python's, and anybody can use it."""

import itertools
import json
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from tactilerl.envs import layouts
from tactilerl.placement import choice, cover, page
from tactilerl.placement.candidates import DesignFlags, Pool
from tactilerl.placement.cover import NEVER, Starts

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed")
N_STARTS = 60
READY = """new Promise((go) => {
    const wait = () => typeof dots === "object" && dots ? go() : setTimeout(wait, 50);
    wait();
})"""
MIDDLE = """(() => {
    const node = document.querySelector('CSS');
    node.scrollIntoView({ block: "center", inline: "center" });
    const box = node.getBoundingClientRect();
    return [box.x + box.width / 2, box.y + box.height / 2];
})()"""
TEXT = "document.getElementById('{}').textContent"
COLOURS = """[...document.querySelectorAll("p, td, th, button, h1, label")].map((node) => {
    const look = getComputedStyle(node);
    return [look.color, look.backgroundColor];
})"""


class Browser:
    """Chromium with one page, spoken to over a pipe (Chrome DevTools Protocol)."""

    def __init__(self, url, width):
        read_theirs, self._write = os.pipe()
        self._read, write_theirs = os.pipe()
        flags = "--headless --no-sandbox --disable-gpu --remote-debugging-pipe"
        flags += " --disable-ipc-flooding-protection"  # which drops addresses of quick clicks
        redirected = f"exec {CHROMIUM} {flags} 3<&{read_theirs} 4>&{write_theirs}"
        self._process = subprocess.Popen(
            ["bash", "-c", redirected],
            pass_fds=(read_theirs, write_theirs),
            stderr=subprocess.DEVNULL,
        )
        os.close(read_theirs), os.close(write_theirs)
        self._numbers, self._rest, self._session = itertools.count(1), b"", {}
        target = self("Target.createTarget", url="about:blank")["targetId"]
        session = self("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        self._session = {"sessionId": session}
        metrics = dict(width=width, height=900, deviceScaleFactor=1, mobile=width < 500)
        self("Emulation.setDeviceMetricsOverride", **metrics)
        self("Page.navigate", url=url)
        self.run(READY)

    def __call__(self, method, **params):
        number = next(self._numbers)
        message = {"id": number, "method": method, "params": params, **self._session}
        os.write(self._write, json.dumps(message).encode() + b"\0")
        while True:
            while b"\0" not in self._rest:
                self._rest += os.read(self._read, 1 << 20)
            answer, self._rest = self._rest.split(b"\0", 1)
            if (answer := json.loads(answer)).get("id") == number:
                assert "error" not in answer, answer
                return answer["result"]

    def run(self, script):
        """The value of a script."""
        result = self("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def click(self, css):
        """Click in the middle of an element."""
        x, y = self.run(MIDDLE.replace("CSS", css))
        for kind in ("mousePressed", "mouseReleased"):
            self("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def press(self, key):
        for kind in ("keyDown", "keyUp"):
            self("Input.dispatchKeyEvent", type=kind, key=key)

    def own(self):
        """What the page says of the set that is shown."""
        return json.loads(self.run("document.getElementById('results').dataset.own"))

    def close(self):
        self("Browser.close")
        self._process.wait(10)
        os.close(self._read), os.close(self._write)


def played(rng, n_taxels):
    """Starts in which taxels fire and closing succeeds at random."""
    fires = rng.integers(8, 30, (N_STARTS, n_taxels)).astype(np.uint8)
    fires[rng.random(fires.shape) < 0.8] = NEVER
    succeeds = np.zeros((N_STARTS, NEVER + 1), bool)
    succeeds[:, 8:30] = rng.random((N_STARTS, 22)) < 0.7
    sets_off, lets_go = np.zeros(N_STARTS, int), np.full(N_STARTS, 20)
    return Starts(fires, succeeds, sets_off, lets_go)


@pytest.fixture(scope="module", params=["", "digit"])
def design(request):
    flags = DesignFlags(
        scene=("handover",), skin="6mm", survives=request.param, start_closing=(0.2, 0.3)
    )
    pool, rng = Pool.of(flags), np.random.default_rng(0)
    recorded = [{wait: played(rng, len(pool.skin)) for wait in flags.start_closing} for _ in range(2)]
    judge = choice.Judge(*recorded, pool)
    rows = [judge.row("chosen", pool.columns[:3])]
    use = choice.Use(None, 0.9, 0.2, "timed", 0.2)
    rows.append(choice._without(use, len(judge)))
    return choice.Design(pool, *recorded, {3: pool.columns[:3]}, None, rows, [use]), judge


@pytest.fixture
def browser(design, tmp_path, request):
    (tmp_path / "design.html").write_bytes(page.page(design[0]))
    width = getattr(request, "param", 1000)
    browser = Browser(f"file://{tmp_path / 'design.html'}", width)
    yield browser
    browser.close()


@needs_chromium
class TestPage:
    def test_fifty_sets_have_pythons_numbers(self, design, browser):
        (design, judge), rng = design, np.random.default_rng(1)
        browser.click("#clear")
        for n in rng.integers(1, 12, 50):
            taxels = sorted(rng.choice(design.pool.columns, n, replace=False).tolist())
            browser.click("#clear")
            for taxel in taxels:
                browser.click(f'[data-taxel="{taxel}"] circle')
            shown, expected = browser.own(), judge.row("your set", taxels)
            assert shown["taxels"] == n
            for key in ("success", "felt", "worst", "success_interval", "worst_interval"):
                assert shown[key] == pytest.approx(getattr(expected, key)), (key, taxels)
            assert (shown["lost"], shown["start_closing"]) == (expected.lost, expected.start_closing)
            assert browser.run("location.hash") == f"#t={'.'.join(map(str, taxels))}"
        browser.click("#kill")
        browser.click(f'[data-taxel="{taxels[0]}"] circle')
        starts = design.test[expected.start_closing]
        assert browser.own()["success"] == pytest.approx(cover.value(starts, taxels[1:]))
        text = browser.run("layoutFile()")
        saved = layouts.load(text).place(design.pool.hand)
        assert {*saved.names} == {design.pool.skin.names[taxel] for taxel in taxels}

    @pytest.mark.parametrize("browser", [390], indirect=True)
    def test_on_a_phone_by_keyboard_and_for_weak_eyes(self, design, browser):
        assert browser.run("document.documentElement.scrollWidth") <= 390
        assert "best one without touch (timed) in 0.20" in browser.run(TEXT.format("verdict"))
        assert "no touch" in browser.run(TEXT.format("results"))
        sizes = "[...document.querySelectorAll('#map .chosen circle')].map(x => x.r.baseVal.value)"
        assert browser.run(sizes) == [2.0] * 3
        last = "[...document.querySelectorAll('#map g')].slice(-3).every(x => x.matches('.chosen'))"
        assert browser.run(last)
        browser.click("#clear")
        spacing = 6 * browser.run("document.getElementById('map').getScreenCTM().a")
        assert spacing >= 24  # px, as WCAG wants of what is tapped
        browser.click(f'[data-taxel="{design[0].pool.free[40]}"] circle')
        assert browser.own()["taxels"] == 1
        browser.click("#clear")
        browser.run("document.querySelector('#map [tabindex=\"0\"]').focus()")
        browser.press("Enter")
        browser.press("ArrowUp")
        browser.press("Enter")
        assert browser.own()["taxels"] == 2
        browser.press("k")
        assert "1 dead" in browser.own()["layout"]
        assert "mm towards the tip" in browser.run("document.getElementById('spot').textContent")
        address = browser.run("location.hash")
        browser.run(f"choose([]); location.hash = '{address}'; fromAddress()")
        assert browser.run("chosen.size + dead.size") == 3
        for pair in {tuple(pair) for pair in browser.run(COLOURS)}:
            assert contrast(*pair) >= 4.5, pair
        look = "getComputedStyle(document.querySelector('{}')).{}"
        dot = browser.run(look.format("#map g:not(.chosen) circle", "stroke"))
        chosen = browser.run(look.format(".chosen circle", "fill"))
        panel = browser.run(look.format("#map rect", "fill"))
        assert min(contrast(dot, panel), contrast(chosen, panel)) >= 3.0


def contrast(*colours):
    """WCAG's ratio of two CSS colours."""
    shades = []
    for colour in colours:
        parts = [float(part) for part in colour[colour.index("(") + 1 : -1].split(",")]
        parts = parts if len(parts) == 3 or parts[3] else [255.0] * 3
        linear = [c / 12.92 if c <= 0.03928 else ((c + 0.055) / 1.055) ** 2.4
                  for c in (part / 255 for part in parts[:3])]  # fmt: skip
        shades.append(float(np.dot([0.2126, 0.7152, 0.0722], linear)))
    return (max(shades) + 0.05) / (min(shades) + 0.05)


def test_the_page_in_the_docs_is_of_today():
    template = page.TEMPLATE.read_text().split("@DATA@")
    shown = (Path(__file__).parents[2] / "docs/assets/design.html").read_text()
    assert [shown[: len(template[0])], shown[-len(template[1]) :]] == template
