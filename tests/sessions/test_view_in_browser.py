"""The live page in a real browser: no script complains, it keeps up, its buttons do what they say. ``-m browser``."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.helpers.chromium import Tab, chromium
from tests.helpers.run_view import RunningView, running_view
from tests.helpers.sim_bench import write_bench

pytestmark = [pytest.mark.browser, pytest.mark.opencv]

DRAWN = "document.body && Number(document.body.dataset.drawn || 0)"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("view")


@pytest.fixture(scope="module")
def tab(folder: Path) -> Iterator[Tab]:
    with chromium(folder) as opened:
        yield opened


@pytest.fixture(scope="module")
def view(folder: Path) -> Iterator[RunningView]:
    bench = write_bench(folder / "bench")
    words = ("--beacon", bench.parent / "any.toml", "--camera", bench.parent / "camera.yaml")
    with running_view(folder, f"sim:{bench}", *words, "--snapshots", folder / "snaps") as running:
        yield running


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize(("width_px", "height_px"), [(1280, 900), (400, 800)])
def test_the_page_shows_everything_and_complains_of_nothing(tab, view, width_px, height_px, scheme):
    tab.complaints.clear()
    tab.look(view.address, width_px, height_px, scheme)
    tab.wait_for(f"{DRAWN} > 20", 60.0)
    assert tab.evaluate("document.documentElement.scrollWidth <= innerWidth")
    assert tab.evaluate("document.querySelector('#status').textContent") in ("pose", "no pose")
    assert tab.evaluate("document.querySelectorAll('#marks > *').length") >= 4
    assert tab.evaluate("document.querySelectorAll('#curves canvas').length") == 6
    assert tab.evaluate("document.querySelector('#stream').naturalWidth") == 640
    assert tab.evaluate("document.querySelectorAll('.slider').length") == 6
    # Nothing that has to be touched is smaller than a finger.
    low = tab.evaluate("Math.min(...[...document.querySelectorAll('button')].map((b) => b.offsetHeight))")
    assert low >= 34
    paper = tab.evaluate("getComputedStyle(document.body).backgroundColor")
    assert (paper == "rgb(255, 255, 255)") == (scheme == "light")
    assert tab.complaints == []


def test_how_often_it_is_drawn(tab, view, capsys):
    tab.look(view.address, 1280, 900, "light")
    tab.wait_for(f"{DRAWN} > 5", 60.0)
    first, begun_s = tab.evaluate(DRAWN), time.monotonic()
    time.sleep(5.0)
    drawn, span_s = tab.evaluate(DRAWN) - first, time.monotonic() - begun_s
    with capsys.disabled():
        print(f"\nthe page was drawn {drawn / span_s:.1f} times a second over {span_s:.1f} s (20 wanted, not asserted)")
    assert drawn > 0


def test_a_slider_reaches_the_sensor_and_comes_back(tab, view):
    tab.look(view.address, 1280, 900, "light")
    tab.wait_for("document.querySelectorAll('.slider').length === 6", 60.0)
    set_to = "(() => {{ const i = document.querySelector('[aria-label=\"{0}\"]'); i.value = {1};"
    set_to += "i.dispatchEvent(new Event('input')); i.dispatchEvent(new Event('change')); return true; }})()"
    # No blob of pixels is a circle.
    tab.evaluate(set_to.format("min_circularity", 1000))
    tab.wait_for("document.querySelector('#status').textContent === 'no pose'")
    tab.evaluate(set_to.format("min_circularity", 500))
    tab.wait_for("document.querySelector('#status').textContent === 'pose'")
    tab.wait_for("document.querySelector('[aria-label=\"min_circularity\"]').previousSibling.textContent === '0.50'")
    setup = next(data for name, data in view.events() if name == "setup")
    assert {slider["name"]: slider["value"] for slider in setup["sliders"]}["min_circularity"] == 0.5


def test_the_snapshot_button_saves_a_picture(tab, view, folder):
    tab.look(view.address, 400, 800, "dark")
    tab.wait_for(f"{DRAWN} > 5", 60.0)
    before = len(list((folder / "snaps").glob("*.png")))
    tab.evaluate("document.querySelector('#snapshot').click()")
    tab.wait_for("document.querySelector('#said').textContent.startsWith('saved')")
    assert len(list((folder / "snaps").glob("*.png"))) == before + 1


def test_the_gantry_is_out_of_reach_and_the_server_refuses_too(tab, view):
    tab.look(view.address, 1280, 900, "light")
    tab.wait_for(f"{DRAWN} > 5", 60.0)
    assert tab.evaluate("[...document.querySelectorAll('[data-motion]')].every((button) => button.disabled)")
    assert tab.evaluate("document.querySelectorAll('#axes button').length") == 0
    status = tab.evaluate(
        "fetch('jog', {method: 'POST', body: '{\"axis\": \"X\", \"offset\": 0.001}', headers: "
        "{'Content-Type': 'application/json', 'X-Uvgs-Key': location.hash.slice(1)}}).then((answer) => answer.status)"
    )
    assert status == 403
    tab.complaints.clear()


def test_without_the_key_one_only_looks(tab, view):
    tab.look(view.base, 1280, 900, "light")
    tab.wait_for(f"{DRAWN} > 5", 60.0)
    assert tab.evaluate("document.querySelector('#nokey').hidden") is False
    assert tab.evaluate("[...document.querySelectorAll('button, .slider input')].every((item) => item.disabled)")


def test_another_page_of_the_same_browser_changes_and_reads_nothing(tab, view, folder):
    """A page of a file, which knows even the key, is another origin."""
    (folder / "evil.html").write_text("<!doctype html><title>evil</title><body>evil</body>")
    tab.look((folder / "evil.html").as_uri(), 1280, 900, "light")
    tab.wait_for("document.title === 'evil'")
    asked = "fetch('%stune', {method: 'POST', mode: '%s', body: '{\"changes\": {\"threshold_k\": 9}}', headers: %s})"
    asked += ".then((answer) => answer.type + answer.status, () => 'failed')"
    key = f"{{'Content-Type': 'application/json', 'X-Uvgs-Key': '{view.key}'}}"
    assert tab.evaluate(asked % (view.base, "cors", key)) == "failed"
    tab.evaluate(asked % (view.base, "no-cors", "{'Content-Type': 'text/plain'}"))
    assert tab.evaluate(f"fetch('{view.base}').then(() => 'read', () => 'failed')") == "failed"
    setup = next(data for name, data in view.events() if name == "setup")
    assert {slider["name"]: slider["value"] for slider in setup["sliders"]}["threshold_k"] != 9.0
    tab.complaints.clear()
