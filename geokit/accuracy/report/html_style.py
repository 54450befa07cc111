"""Style sheet of the page, for screen and print, and its optional script."""

from __future__ import annotations

__all__ = ["SCRIPT", "STYLE"]

STYLE = """
:root { color-scheme: light; }
body { margin: 0 auto; max-width: 62rem; padding: 1rem; background: #fff; color: #1b1b1b;
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Liberation Sans", sans-serif; }
h1 { font-size: 1.7rem; margin: .5rem 0; }
h2 { font-size: 1.3rem; margin: 0 0 .3rem; }
h3 { font-size: 1rem; margin: 1.2rem 0 .3rem; }
section { border-top: 1px solid #d8d8d8; margin-top: 2rem; padding-top: 1.2rem; }
p, ul { margin: .4rem 0; }
a { color: #005a94; }
.quiet { color: #555; font-size: .9rem; }
.failed { color: #8a2b00; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .85rem; font-variant-numeric: tabular-nums; margin: .4rem 0; }
th, td { padding: .2rem .6rem; text-align: left; border-bottom: 1px solid #e4e4e4; vertical-align: top; }
thead th { border-bottom: 2px solid #999; }
td.number, th.number { text-align: right; white-space: nowrap; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .1rem 1rem; font-size: .9rem; }
dt { color: #555; }
dd { margin: 0; }
svg.chart { width: 100%; min-width: 34rem; height: auto; font-size: 13px; }
svg .grid { stroke: #e6e6e6; }
svg .axis { stroke: #444; fill: none; }
svg .front { stroke: #333; stroke-width: 1.5; fill: none; }
svg line.level { stroke: #777; stroke-dasharray: 2 3; }
svg text.level { fill: #555; font-size: 12px; }
svg .tick { fill: #333; }
svg .label { text-anchor: middle; fill: #1b1b1b; }
svg .letter { font-weight: bold; }
svg .mark { cursor: pointer; }
svg .mark:hover > :not(title), svg .mark:focus > :not(title) { stroke-width: 4; }
svg .mark:focus { outline: none; }
.legend { list-style: none; padding: 0; display: flex; flex-wrap: wrap; gap: .2rem 1.2rem; font-size: .9rem; }
.swatch { width: 16px; height: 16px; vertical-align: -3px; margin-right: .35rem; }
.swatch.line { width: 30px; }
figure { margin: .6rem 0; }
figure img { max-width: 100%; height: auto; border: 1px solid #e4e4e4; }
figcaption { font-size: .9rem; color: #444; }
#tip { position: fixed; display: none; max-width: 26rem; padding: .4rem .6rem; background: #1b1b1b; color: #fff;
  font-size: .82rem; white-space: pre-line; border-radius: 4px; pointer-events: none; z-index: 9; }
@media (max-width: 40rem) { body { padding: .6rem; font-size: 15px; } h1 { font-size: 1.4rem; } }
@page { size: A4 landscape; margin: 12mm; }
@media print {
  body { max-width: none; font-size: 10pt; }
  .wide { overflow: visible; }
  svg.chart { min-width: 0; }
  figure, svg.chart, tr { break-inside: avoid; }
  h2, h3 { break-after: avoid; }
  table { font-size: 7.5pt; }
  th, td { padding: .1rem .3rem; }
  #tip { display: none !important; }
}
"""

# Without the script, browsers show the titles of the marks themselves after a moment.
SCRIPT = """
(function () {
  var tip = document.getElementById("tip");
  function show(mark, x, y) {
    tip.textContent = mark.getAttribute("data-tip");
    tip.style.display = "block";
    var box = tip.getBoundingClientRect();
    tip.style.left = Math.max(4, Math.min(x + 14, innerWidth - box.width - 4)) + "px";
    tip.style.top = (y + 18 + box.height > innerHeight ? Math.max(4, y - box.height - 12) : y + 18) + "px";
  }
  function hide() { tip.style.display = "none"; }
  document.querySelectorAll(".mark").forEach(function (mark) {
    var title = mark.querySelector("title");
    mark.setAttribute("data-tip", title.textContent);
    mark.setAttribute("aria-label", title.textContent);
    title.remove();
    mark.addEventListener("mousemove", function (event) { show(mark, event.clientX, event.clientY); });
    mark.addEventListener("mouseleave", hide);
    mark.addEventListener("focus", function () {
      var box = mark.getBoundingClientRect();
      show(mark, box.right, box.bottom);
    });
    mark.addEventListener("blur", hide);
  });
})();
"""
