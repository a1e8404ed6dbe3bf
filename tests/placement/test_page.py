"""The page of a design, in headless Chromium: its numbers are Python's, and anybody can use it."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from tactilerl.envs import layouts
from tactilerl.envs.sensors import Cost
from tactilerl.pictures.hand_map import Unrolled
from tactilerl.placement import choice, cover, page
from tactilerl.placement.candidates import DesignFlags, Pool, Prices, groups_of
from tactilerl.placement.cover import NEVER, Starts

from browser import Browser, needs_chromium

N_STARTS = 60
READY = "typeof dots === 'object' && dots"
TEXT = "document.getElementById('{}').textContent"


def own(browser):
    """What the page says of the set that is shown."""
    return json.loads(browser.run("document.getElementById('results').dataset.own"))


def played(rng, n_taxels):
    """Starts in which taxels fire and closing succeeds at random."""
    fires = rng.integers(8, 30, (N_STARTS, n_taxels)).astype(np.uint8)
    fires[rng.random(fires.shape) < 0.8] = NEVER
    succeeds = np.zeros((N_STARTS, NEVER + 1), bool)
    succeeds[:, 8:30] = rng.random((N_STARTS, 22)) < 0.7
    sets_off, lets_go = np.zeros(N_STARTS, int), np.full(N_STARTS, 20)
    return Starts(fires, succeeds, sets_off, lets_go)


@pytest.fixture(scope="module", params=[pytest.param("", marks=pytest.mark.slow), "digit"])
def design(request):
    scene = dict(scene=("handover",), skin="6mm", start_closing=(0.2, 0.3))
    flags = DesignFlags(**scene, survives=request.param)
    pool, rng = Pool.of(flags), np.random.default_rng(0)
    if request.param:
        boards = groups_of("digit", pool.hand, pool.skin, "boards").members.argmax(axis=0)
        flags = dataclasses.replace(flags, budget=100.0)
        pool = dataclasses.replace(pool, flags=flags, prices=Prices(Cost(6.0, 40.0, 2), boards))
    recorded = [{wait: played(rng, len(pool.skin)) for wait in flags.start_closing} for _ in range(2)]
    judge = choice.Judge(pool, *recorded)
    chosen = judge.row("chosen", pool.whole[:3])
    if request.param:
        chosen = dataclasses.replace(chosen, price=98.0)
    sets = {98.0 if request.param else 3: pool.whole[:3]}
    return choice.Design(judge, sets, [choice.Row("no touch", 0, 0.2, 0.0, 0.2), chosen], "timed")


@pytest.fixture
def browser(design, tmp_path, request):
    (tmp_path / "design.html").write_bytes(page.page(design))
    width = getattr(request, "param", 1000)
    browser = Browser(f"file://{tmp_path / 'design.html'}", width, READY)
    yield browser
    browser.close()


@needs_chromium
class TestPage:
    def test_sets_have_pythons_numbers(self, design, browser):
        judge, rng = design.judge, np.random.default_rng(1)
        browser.click("#clear")
        for n in rng.integers(1, 12, 15):
            taxels = sorted(rng.choice(design.pool.whole, n, replace=False).tolist())
            browser.click("#clear")
            for taxel in taxels:
                browser.click(f'[data-taxel="{taxel}"] circle')
            shown, expected = own(browser), judge.row("your set", taxels)
            assert shown["taxels"] == n
            assert shown["price"] == (design.pool.prices and design.pool.prices.of(taxels))
            for key in ("success", "felt", "worst", "success_interval", "worst_interval"):
                assert shown[key] == pytest.approx(getattr(expected, key)), (key, taxels)
            assert (shown["lost"], shown["start_closing"]) == (expected.lost, expected.start_closing)
            assert browser.run("location.hash") == f"#t={'.'.join(map(str, taxels))}"
        browser.click("#kill")
        browser.click(f'[data-taxel="{taxels[0]}"] circle')
        starts = judge.test[expected.start_closing]
        assert own(browser)["success"] == pytest.approx(cover.value(starts, taxels[1:]))
        text = browser.run("layoutFile()")
        saved = layouts.load(text).place(design.pool.hand)
        assert {*saved.names} == {design.pool.skin.names[taxel] for taxel in taxels}

    @pytest.mark.parametrize("browser", [390], indirect=True)
    def test_on_a_phone_by_keyboard_and_on_paper(self, design, browser):
        assert browser.run("document.documentElement.scrollWidth") <= 390
        said = browser.run(TEXT.format("verdict"))
        assert "best one without touch (timed, as the gate finds it) in 0.20" in said
        assert "no touch" in browser.run(TEXT.format("results"))
        number, unit = (browser.run(TEXT.format(name)) for name in ("number", "unit"))
        is_priced = bool(design.pool.prices)
        assert (number, unit) == (("98 for 3", "price") if is_priced else ("3", "number of taxels"))
        assert browser.run("document.querySelectorAll('#legend-of-set li').length") == 3
        sizes = "[...document.querySelectorAll('#map .chosen circle')].map(x => x.r.baseVal.value)"
        assert browser.run(sizes) == [2.0] * 3
        last = "[...document.querySelectorAll('#map g')].slice(-3).every(x => x.matches('.chosen'))"
        assert browser.run(last)
        browser.click("#clear")
        spacing = 6 * browser.run("document.getElementById('map').getScreenCTM().a")
        assert spacing >= 24  # px, as WCAG wants of what is tapped
        browser.click(f'[data-taxel="{design.pool.whole[40]}"] circle')
        assert own(browser)["taxels"] == 1
        browser.click("#clear")
        browser.run("document.querySelector('#map [tabindex=\"0\"]').focus()")
        browser.press("Enter")
        browser.press("ArrowUp")
        browser.press("Enter")
        assert own(browser)["taxels"] == 2
        browser.press("k")
        assert "1 dead" in own(browser)["layout"]
        assert "segment, 6 mm towards the" in browser.run("document.getElementById('spot').textContent")
        address = browser.run("location.hash")
        browser.run(f"choose([]); location.hash = '{address}'; fromAddress()")
        assert browser.run("chosen.size + dead.size") == 3
        browser("Emulation.setEmulatedMedia", media="print")
        ruler = "[...document.querySelectorAll('.printed')].at(-2).getBoundingClientRect().width"
        assert browser.run(ruler) == pytest.approx(50 * 96 / 25.4, abs=1.0)  # as it says, and so all is
        left, right, *_ = Unrolled(design.pool.hand).extent
        printed = browser.run("document.getElementById('map').getBoundingClientRect().width")
        assert printed == pytest.approx(96 / 25.4 * (right - left), abs=0.5)  # a mm is one on paper


def test_the_page_in_the_docs_is_of_today():
    template = page.TEMPLATE.read_text().split("@DATA@")
    shown = (Path(__file__).parents[2] / "docs/assets/design.html").read_text()
    assert [shown[: len(template[0])], shown[-len(template[1]) :]] == template
