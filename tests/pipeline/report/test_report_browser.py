"""The page in a real browser: it needs nothing but itself, its map answers with the rasters' values, 3-D draws."""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from toys.browser import Browser
from toys.finished import COLS, LATTICE, ROWS, bundles, report, view

from rille.stages.core.declare import Bundle


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder, made = tmp_path_factory.mktemp("page"), bundles()
    reason, p_hazard = (np.arange(ROWS * COLS).reshape(ROWS, COLS) % n for n in (2048, 101))
    arrays = {"reason": reason.astype(np.uint16), "p_hazard": (p_hazard / 100).astype(np.float32)}
    made["risk"] = Bundle({**made["risk"].arrays, **arrays}, made["risk"].meta)
    report(folder, view(made))
    return folder / "report.html"


@pytest.fixture
def browser(chromium: str, page: Path, tmp_path: Path) -> Iterator[Browser]:
    found = Browser(chromium, tmp_path)
    found.open(page)
    yield found
    found.close()


def _click(browser: Browser, name: str) -> None:
    browser.run(f"document.querySelector('[data-at={name}]').click()")


REFERENCES = Path(__file__).parent / "pictures"
"""Screenshots of 48 columns; ``RILLE_NEW_PICTURES=1`` writes them anew: look at them before they are committed."""


def _small(png: bytes) -> Image.Image:
    """So small that letters are grey: fonts differ between machines, the layout does not."""
    picture = Image.open(io.BytesIO(png)).convert("RGB")
    return picture.resize((48, round(48 * picture.height / picture.width)), Image.Resampling.BOX)


def _pixels(png: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"), dtype=np.int64)


def test_it_opens_from_disk_without_a_request_or_a_message(browser: Browser, page: Path) -> None:
    assert browser.messages == []
    assert [a for a in browser.requests if not a.startswith("data:")] == [page.resolve().as_uri()]


def test_the_map_answers_with_the_values_of_the_cells(browser: Browser) -> None:
    made = bundles()
    z, sigma, risk = made["tile"]["elevation"], made["tile"]["elevation_std"], made["risk"]["risk"]
    step = float(np.nanmax(z) - np.nanmin(z)) / 65534
    draw = np.random.default_rng(7)
    for row, col in zip(draw.integers(0, ROWS, 10), draw.integers(0, COLS, 10), strict=True):
        x, y = LATTICE["x0"] + LATTICE["cell"] * col, LATTICE["y0"] - LATTICE["cell"] * row
        found = browser.run(f"document.getElementById('map-view').answer({x}, {y})")
        assert found["cell"] == row * COLS + col
        assert found["risk"] == risk[row, col]
        assert found["reason"] == (row * COLS + col) % 2048
        assert found["p_hazard"] == pytest.approx((row * COLS + col) % 101 / 100, abs=0.5 / 254 + 1e-6)
        if np.isfinite(z[row, col]):
            assert found["elevation"] == pytest.approx(float(z[row, col]), abs=step)
            assert found["sigma"] == pytest.approx(float(sigma[row, col]), rel=0.02)
        else:
            assert not found["elevation"]


def test_layers_switch_and_3d_draws_and_turns(browser: Browser) -> None:
    shown = []
    for layer in ("none", "elevation", "risk"):
        browser.run(
            f"(() => {{ const s = document.querySelector('[data-at=layer]'); s.value = '{layer}';"
            " s.dispatchEvent(new Event('change')); })()"
        )
        shown.append(_pixels(browser.picture()))
    assert (shown[0] != shown[1]).any()
    assert (shown[1] != shown[2]).any()
    _click(browser, "three")
    drawn = "(() => { const c = document.querySelector('[data-at=space]'), g = c.getContext('webgl2'), "
    drawn += "p = new Uint8Array(4 * c.width * c.height); g.readPixels(0, 0, c.width, c.height, g.RGBA, "
    drawn += "g.UNSIGNED_BYTE, p); let n = 0; for (let i = 3; i < p.length; i += 4) n += p[i] > 0; "
    drawn += "return n / c.width / c.height; })()"
    assert browser.run(drawn) > 0.05
    before = _pixels(browser.picture())
    key = "new KeyboardEvent('keydown', {key: 'ArrowLeft'})"
    browser.run(f"document.querySelector('[data-at=space]').dispatchEvent({key})")
    assert (before != _pixels(browser.picture())).any()
    assert browser.messages == []


def test_the_slider_goes_from_stop_to_stop(browser: Browser) -> None:
    before = _pixels(browser.picture())
    browser.run(
        "(() => { const s = document.querySelector('[data-at=stop]'); s.value = 1;"
        " s.dispatchEvent(new Event('input')); })()"
    )
    assert browser.run("document.querySelector('.strip .here').dataset.frame") == "4"
    assert browser.run("document.querySelector('[data-at=hover]').textContent").startswith("stop 2 of 2, frame 4")
    assert (before != _pixels(browser.picture())).any()
    assert browser.messages == []


def test_a_phone_in_the_dark_shows_no_page_wider_than_itself(chromium: str, page: Path, tmp_path: Path) -> None:
    phone = Browser(chromium, tmp_path, 390, 844, dark=True)
    try:
        phone.open(page)
        assert phone.run("document.documentElement.scrollWidth") <= 390
        assert phone.run("getComputedStyle(document.body).backgroundColor") == "rgb(21, 23, 27)"
        assert phone.run("document.querySelector('[data-at=flat]').clientHeight") > 200
        phone.run("document.getElementById('trajectory').scrollIntoView()")
        assert np.median(_pixels(phone.picture())) < 60  # a drawing's paper is dark too
    finally:
        phone.close()


@pytest.mark.parametrize("view", ["map", "space"])
@pytest.mark.parametrize(("width", "dark"), [(1280, False), (390, False), (390, True)], ids=["wide", "phone", "dark"])
def test_it_looks_as_it_did(chromium: str, page: Path, tmp_path: Path, width: int, dark: bool, view: str) -> None:
    shown = Browser(chromium, tmp_path, width, 844, dark=dark)
    try:
        shown.open(page)
        if view == "space":
            _click(shown, "three")
        shown.run("document.getElementById('map-view').scrollIntoView()")
        found = _small(shown.picture())
    finally:
        shown.close()
    reference = REFERENCES / f"{view}-{width}{'-dark' * dark}.png"
    if os.environ.get("RILLE_NEW_PICTURES") == "1":
        reference.parent.mkdir(exist_ok=True)
        found.save(reference)
    wanted = np.asarray(Image.open(reference), dtype=np.float64)
    off = np.abs(np.asarray(found, dtype=np.float64) - wanted).mean()
    assert off < 4, f"{off:.1f} of 255 grey levels on average: compare with {reference}"


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
@pytest.mark.parametrize("width", [390, 1280])
def test_axe_finds_no_violation(chromium: str, page: Path, tmp_path: Path, width: int, dark: bool) -> None:
    axe = resources.files("axe_core_python").joinpath("axe.min.js").read_text(encoding="utf-8")
    shown = Browser(chromium, tmp_path, width, 844, dark=dark)
    try:
        shown.open(page)
        shown.run("document.querySelectorAll('details').forEach((d) => { d.open = true; })")
        shown.run(axe + "; 0")
        found = shown.run("axe.run().then((r) => r.violations.map((v) => [v.id, v.nodes[0].html]))")
        assert found == []
    finally:
        shown.close()
