"""Style sheet of the page, for screen and print, and its optional script."""

from __future__ import annotations

STYLE = """
:root { color-scheme: light dark; --page: #fff; --ink: #1b1b1b; --quiet: #555; --line: #e0e0e0; --strong: #888;
  --link: #005a94; --failed: #8a2b00; --shade: rgba(0, 0, 0, .22); }
@media screen and (prefers-color-scheme: dark) {
  :root { --page: #15181c; --ink: #e4e4e4; --quiet: #a8a8a8; --line: #363b42; --strong: #7a828c; --link: #7cc0f0;
    --failed: #ff9d6e; --shade: rgba(160, 190, 220, .35); }
  /* Blue and black are too dark there. */
  svg [stroke="#0072B2"] { stroke: #4aa8e0; }
  svg [fill="#0072B2"] { fill: #4aa8e0; }
  svg [stroke="#000000"] { stroke: #e4e4e4; }
  svg [fill="#000000"] { fill: #e4e4e4; }
}
body { margin: 0 auto; max-width: 84rem; padding: 1rem; background: var(--page); color: var(--ink);
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Liberation Sans", sans-serif; }
h1 { font-size: 1.7rem; margin: .5rem 0; }
h2 { font-size: 1.3rem; margin: 0 0 .3rem; }
h3 { font-size: 1rem; margin: 1.2rem 0 .3rem; }
section { border-top: 1px solid var(--line); margin-top: 2rem; padding-top: 1.2rem; }
p, ul { margin: .4rem 0; max-width: 62rem; overflow-wrap: anywhere; }
nav ul { columns: 28rem; max-width: none; }
a { color: var(--link); }
.quiet { color: var(--quiet); font-size: .9rem; }
.failed { color: var(--failed); }
/* A table or chart that is too wide scrolls in its box; a shade at an edge says that there is more. */
.wide { overflow-x: auto; background: linear-gradient(90deg, var(--page) 1rem, transparent) local,
  linear-gradient(270deg, var(--page) 1rem, transparent) right / 2rem 100% no-repeat local,
  linear-gradient(90deg, var(--shade), transparent .7rem), linear-gradient(270deg, var(--shade), transparent .7rem); }
table { border-collapse: collapse; font-size: .85rem; font-variant-numeric: tabular-nums; margin: .4rem 0; }
th, td { padding: .2rem .6rem; text-align: left; border-bottom: 1px solid var(--line); vertical-align: top; }
thead th { border-bottom: 2px solid var(--strong); }
td.number, th.number { text-align: right; white-space: nowrap; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .1rem 1rem; font-size: .9rem; }
dt { color: var(--quiet); }
dd { margin: 0; overflow-wrap: anywhere; }
svg.chart { display: block; width: 100%; max-width: 62rem; height: auto; font-size: 13px; }
svg text { fill: var(--ink); }
svg .grid { stroke: var(--line); }
svg .axis { stroke: var(--strong); fill: none; }
svg .front { stroke: var(--ink); stroke-width: 1.5; fill: none; }
svg line.level { stroke: var(--strong); stroke-dasharray: 2 3; }
svg text.level { fill: var(--quiet); font-size: 12px; }
svg .label { text-anchor: middle; }
svg .letter { font-weight: bold; }
svg .hollow { fill: var(--page); }
svg .ring { stroke: var(--ink); }
svg .mark { cursor: pointer; }
svg .mark:hover > :not(title), svg .mark:focus > :not(title) { stroke-width: 4; }
svg .mark:focus { outline: none; }
.legend { list-style: none; padding: 0; display: flex; flex-wrap: wrap; gap: .2rem 1.2rem; font-size: .9rem; }
.swatch { width: 16px; height: 16px; vertical-align: -3px; margin-right: .35rem; }
.swatch.line { width: 30px; }
figure { margin: .6rem 0; }
figure img { max-width: 100%; height: auto; border: 1px solid var(--line); background: #fff; }
figcaption { font-size: .9rem; color: var(--quiet); }
#tip { position: fixed; display: none; max-width: min(26rem, 90vw); padding: .4rem .6rem; background: #1b1b1b;
  color: #fff; border: 1px solid var(--strong); font-size: .82rem; white-space: pre-line; border-radius: 4px;
  pointer-events: none; z-index: 9; }
@media screen and (max-width: 40rem) {
  body { padding: .6rem; font-size: 15px; }
  h1 { font-size: 1.4rem; }
  th, td { padding: .2rem .4rem; }
  /* The whole chart at half its size, with text and marks that can still be read and hit. */
  svg.chart, svg text.level { font-size: 23px; }
  svg.chart .mark > * { transform-box: fill-box; transform-origin: center; transform: scale(1.8); }
}
@page { size: A4 landscape; margin: 12mm; }
@media print {
  body { max-width: none; font-size: 10pt; }
  .wide { overflow: visible; background: none; }
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
