"""A chart as inline SVG: no external resources; the title of a mark describes it."""

from __future__ import annotations

import math
from html import escape

from geokit.accuracy.report.plot import Mark, Plot, decade_ticks, tip_of
from geokit.accuracy.report.text import power_text, tick_text
from geokit.render._chart import COLORS

__all__ = ["legend", "svg"]

WIDTH, HEIGHT = 760, 430
LEFT, RIGHT, TOP, BOTTOM = 98, 16, 14, 50
RADIUS = 5.5
# Outlines of the markers, in units of their radius; the first is a circle. They are in the order of matplotlib's
# markers in geokit.render, so that a method looks the same in the page and in the figure.
SHAPES: tuple[tuple[tuple[float, float], ...], ...] = (
    (),
    ((-0.9, -0.9), (0.9, -0.9), (0.9, 0.9), (-0.9, 0.9)),
    ((0.0, -1.15), (1.05, 0.85), (-1.05, 0.85)),
    ((0.0, -1.25), (1.25, 0.0), (0.0, 1.25), (-1.25, 0.0)),
    ((0.0, 1.15), (1.05, -0.85), (-1.05, -0.85)),
    ((-0.35, -1.1), (0.35, -1.1), (0.35, -0.35), (1.1, -0.35), (1.1, 0.35), (0.35, 0.35), (0.35, 1.1), (-0.35, 1.1),
     (-0.35, 0.35), (-1.1, 0.35), (-1.1, -0.35), (-0.35, -0.35)),
    ((-1.1, -0.6), (-0.6, -1.1), (0.0, -0.5), (0.6, -1.1), (1.1, -0.6), (0.5, 0.0), (1.1, 0.6), (0.6, 1.1), (0.0, 0.5),
     (-0.6, 1.1), (-1.1, 0.6), (-0.5, 0.0)),
)  # fmt: skip
DASHES = ("", "7 4", "2 3", "8 3 2 3")


def svg(plot: Plot, title: str, answers: str) -> str:
    """The SVG drawing; ``title`` is its text alternative."""
    parts = [
        f'<svg class="chart" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(title)}" '
        'xmlns="http://www.w3.org/2000/svg">'
    ]
    parts += _axes(plot)
    # At the lower left and upper right, where a chart has no marks.
    levels = ((plot.floor, plot.floor_name, LEFT + 4, "start"), (plot.ceiling, "not finite", WIDTH - RIGHT - 4, "end"))
    for height, name, x, anchor in levels:
        if height is not None:
            y = _y(plot, height)
            parts.append(f'<line class="level" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>')
            parts.append(f'<text class="level" text-anchor="{anchor}" x="{x}" y="{y - 5:.1f}">{escape(name)}</text>')
    for number, front in enumerate(plot.fronts):
        if front:
            dash = DASHES[number % len(DASHES)]
            parts.append(f'<path class="front" stroke-dasharray="{dash}" d="{_steps(plot, front)}"/>')
    parts += [_mark(plot, mark, answers) for mark in plot.marks]
    parts += [
        f'<text class="letter" x="{_x(plot, mark.x) + 7:.1f}" y="{_y(plot, mark.y) - 7:.1f}">{mark.letter}</text>'
        for front in plot.fronts
        for mark in front
    ]
    return "\n".join([*parts, "</svg>"])


def legend(plot: Plot) -> str:
    """The meaning of colors and lines, as a list."""
    items = [
        f'<li>{_swatch(number, hollow=False)}{escape(name)}</li>'
        for number, name in enumerate(plot.methods)
    ]  # fmt: skip
    for number, device in enumerate(plot.devices):
        line = f'<line class="front" x1="0" x2="30" y1="8" y2="8" stroke-dasharray="{DASHES[number % len(DASHES)]}"/>'
        ring = ", marks with a dark outline" if number else ""
        items.append(
            f'<li><svg class="swatch line" viewBox="0 0 30 16">{line}</svg>front on {escape(device)}{ring}</li>'
        )
    if any(mark.hollow for mark in plot.marks):
        items.append(f"<li>{_swatch(0, hollow=True)}hollow: some answers are wrong</li>")
    return f'<ul class="legend">{"".join(items)}</ul>'


def _x(plot: Plot, value: float) -> float:
    low, high = (math.log10(end) for end in plot.x_range)
    return LEFT + (math.log10(value) - low) / (high - low) * (WIDTH - LEFT - RIGHT)


def _y(plot: Plot, value: float) -> float:
    low, high = (math.log10(end) for end in plot.y_range)
    return HEIGHT - BOTTOM - (math.log10(value) - low) / (high - low) * (HEIGHT - TOP - BOTTOM)


def _axes(plot: Plot) -> list[str]:
    right, bottom = WIDTH - RIGHT, HEIGHT - BOTTOM
    parts: list[str] = []
    for value in decade_ticks(plot.x_range):
        x = _x(plot, value)
        parts.append(f'<line class="grid" x1="{x:.1f}" x2="{x:.1f}" y1="{TOP}" y2="{bottom}"/>')
        parts.append(f'<text class="tick" text-anchor="middle" x="{x:.1f}" y="{bottom + 18}">{tick_text(value)}</text>')
    for value in plot.y_ticks:
        y = _y(plot, value)
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{right}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(f'<text class="tick" text-anchor="end" x="{LEFT - 7}" y="{y + 4:.1f}">{power_text(value)}</text>')
    parts.append(f'<path class="axis" d="M{LEFT} {TOP}V{bottom}H{right}"/>')
    middle = (TOP + bottom) / 2
    parts.append(f'<text class="label" x="{(LEFT + right) / 2}" y="{HEIGHT - 10}">{escape(plot.x_label)}</text>')
    turned = f'transform="translate(20 {middle}) rotate(-90)"'
    parts.append(f'<text class="label" {turned}>{escape(plot.y_label)}</text>')
    return parts


def _steps(plot: Plot, front: list[Mark]) -> str:
    """The front as steps, not slopes: with less time than the next setting needs, no smaller error is available."""
    points = [(_x(plot, mark.x), _y(plot, mark.y)) for mark in front]
    path = f"M{points[0][0]:.1f} {points[0][1]:.1f}"
    return path + "".join(f"H{x:.1f}V{y:.1f}" for x, y in points[1:])


def _mark(plot: Plot, mark: Mark, answers: str) -> str:
    shape = _shape(mark.method, _x(plot, mark.x), _y(plot, mark.y), ring=mark.device > 0, hollow=mark.hollow)
    return f'<g class="mark" tabindex="0"><title>{escape(tip_of(mark.row, answers))}</title>{shape}</g>'


def _shape(method: int, x: float, y: float, *, ring: bool, hollow: bool) -> str:
    color = COLORS[method % len(COLORS)]
    outline = SHAPES[(method + method // len(COLORS)) % len(SHAPES)]
    kinds = " ".join(name for name, given in (("hollow", hollow), ("ring", ring)) if given)
    look = f'class="{kinds}" fill="{color}" stroke="{color}" stroke-width="1.6"'
    if not outline:
        return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{RADIUS}" {look}/>'
    corners = " ".join(f"{x + RADIUS * across:.1f},{y + RADIUS * down:.1f}" for across, down in outline)
    return f'<polygon points="{corners}" {look}/>'


def _swatch(method: int, *, hollow: bool) -> str:
    return f'<svg class="swatch" viewBox="0 0 16 16">{_shape(method, 8.0, 8.0, ring=False, hollow=hollow)}</svg>'
