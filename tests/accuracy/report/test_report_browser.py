"""The report in a real browser: nothing is cut, on a desk and on a phone, in light and dark."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from geokit.accuracy import write_report
from tests.accuracy.report.test_report import results
from tests.support.browser import Browser, missing, running

__all__ = ["results"]
pytestmark = [pytest.mark.slow, pytest.mark.skipif(bool(missing()), reason=missing())]

# Least contrast of text that WCAG 2 asks for (AA).
CONTRAST = 4.5
SCRIPT = """
const light = color => {
  const c = color.match(/[\\d.]+/g).slice(0, 3).map(v => v / 255).map(
    v => v <= .04045 ? v / 12.92 : ((v + .055) / 1.055) ** 2.4);
  return .2126 * c[0] + .7152 * c[1] + .0722 * c[2];
};
const page = light(getComputedStyle(document.body).backgroundColor);
const contrast = element => {
  const ink = light(getComputedStyle(element)[element instanceof SVGElement ? "fill" : "color"]);
  return (Math.max(ink, page) + .05) / (Math.min(ink, page) + .05);
};
const all = selector => [...document.querySelectorAll(selector)];
return {
  page, width: document.documentElement.scrollWidth,
  faint: all("p, td, th, a, dt, li, svg text").filter(e => contrast(e) < arguments[0]).map(e => e.textContent),
  cut: all("section:not(#rows) .wide").filter(e => e.scrollWidth > e.clientWidth).length,
  charts: all("svg.chart").map(e => e.getBoundingClientRect().right),
  letters: all("svg.chart .tick").map(e => e.getBoundingClientRect().height),
};
"""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with running() as found:
        yield found


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1400, 390])
def test_nothing_is_cut_or_faint(browser: Browser, results, tmp_path: Path, width: int, scheme: str) -> None:
    browser.size(width, 900, mobile=width < 800)
    browser.scheme(scheme)
    browser.open(write_report(results, tmp_path / "report", pictures=False))
    seen = browser.run(SCRIPT, CONTRAST)
    assert (seen["page"] < 0.05) is (scheme == "dark")
    assert seen["width"] == width
    assert seen["faint"] == []
    assert len(seen["charts"]) == 2
    assert max(seen["charts"]) <= width
    assert min(seen["letters"]) >= 9.0
    # Wide tables scroll in their box; on a desk those of a chart need not.
    assert bool(seen["cut"]) is (width == 390)
    assert browser.errors == []
