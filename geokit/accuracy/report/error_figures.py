"""Maps of the error: the checked answers of one setting, colored by their error."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geokit.accuracy.report.html import Picture
from geokit.accuracy.report.pareto import cost_of, front_of, knee
from geokit.accuracy.trials.model import Measurement, Subject
from geokit.accuracy.trials.results import Group
from geokit.errors import GeokitError

# Small enough for a page with dozens of figures to load quickly.
SIZE = (460, 340)
# Most points; more would hide each other.
MOST_POINTS = 3000
# Decades below the largest error that share a color: the map shows where large errors are.
DECADES = 6.0
MESH_OPACITY = 0.3
# Diameter of a point [pixels], for many points and for few.
POINT_SIZES = (4.0, 9.0)
FEW_POINTS = 100
WRONG_COLOR = "#D55E00"
# Number of colors in the file's palette.
PALETTE = 256


def chosen_row(group: Group) -> Measurement | None:
    """The setting with the most informative map: the knee of the front, or the worst setting if the knee is exact.

    None if no judgement has positions, or every answer is exact and right.
    """
    wrong = group.chart.vertical == "wrong"

    def badness(row: Measurement) -> float:
        return row.wrong_share if wrong else row.max_error

    known = [row for row in group.rows if row.judgement is not None and row.judgement.positions is not None]
    telling = [row for row in known if badness(row) > 0.0 and (wrong or row.wrong_share < 1.0)]
    if not telling:
        return None
    device = group.rows[0].device
    members = [row for row in group.rows if row.device == device]
    front = [members[place] for place in front_of(members, group.chart.vertical, group.per_call)]
    if front:
        middle = front[knee([cost_of(row, group.per_call) for row in front], [badness(row) for row in front])]
        if any(row is middle for row in telling):
            return middle
    return max(telling, key=badness)


def error_picture(group: Group, subject: Subject) -> Picture | None:
    """A small figure of the most informative answers, or None if there is nothing to show.

    Raises:
        MissingDependencyError: No OpenGL library is usable.
    """
    row = chosen_row(group)
    if row is None or row.judgement is None or row.judgement.positions is None:
        return None
    positions = np.asarray(row.judgement.positions, dtype=np.float64)
    errors = np.asarray(row.judgement.errors, dtype=np.float64)
    wrong = np.asarray(row.judgement.wrong, dtype=bool)
    name = f"{row.method}, {row.setting}, {row.device}"
    if group.chart.vertical == "wrong":
        shown = _some(wrong, errors)
        answers = "wrong answer" if wrong.sum() == 1 else "wrong answers"
        caption = f"{name}: the {int(wrong.sum())} {answers} of {len(wrong)}."
        return Picture(_draw(subject, positions[shown], WRONG_COLOR, ""), caption)
    shown = _some(~wrong & np.isfinite(positions).all(axis=1), errors)
    caption = f"{name}: {len(shown)} of {len(errors)} checked answers by the logarithm of their error"
    if wrong.any():
        caption += f"; the {int(wrong.sum())} wrong ones are left out"
    colors = _decades(errors[shown])
    return Picture(_draw(subject, positions[shown], colors, f"log10 error\n[{group.chart.unit}]"), caption + ".")


def _some(mask: NDArray[np.bool_], errors: NDArray[np.float64]) -> NDArray[np.int64]:
    """Rows to draw: all, or those of the largest errors and evenly many of the others."""
    rows = np.flatnonzero(mask)
    if len(rows) <= MOST_POINTS:
        return rows
    falling = rows[np.argsort(-errors[rows], kind="stable")]
    half = MOST_POINTS // 2
    rest = falling[half:]
    return np.concatenate([falling[:half], rest[np.linspace(0, len(rest) - 1, MOST_POINTS - half).astype(int)]])


def _decades(errors: NDArray[np.float64]) -> NDArray[np.float64]:
    usual = errors[(errors > 0.0) & np.isfinite(errors)]
    high = float(np.log10(usual.max())) if len(usual) else 0.0
    low = max(high - DECADES, float(np.log10(usual.min())) if len(usual) else -1.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        logs = np.log10(errors)
    return np.clip(np.nan_to_num(logs, nan=high, posinf=high, neginf=low), low, high)


def _draw(subject: Subject, positions: NDArray[np.float64], color: Any, label: str) -> bytes:
    from geokit.render import figure

    size = POINT_SIZES[len(positions) < FEW_POINTS]
    scene: dict[str, Any] = {
        "points": positions,
        "point_color": color,
        "label": label,
        "size": SIZE,
        "point_size": size,
    }
    if subject.mesh is not None:
        scene.update(mesh=subject.mesh, opacity=MESH_OPACITY)
    with tempfile.TemporaryDirectory() as folder:
        return smaller(figure(Path(folder) / "picture.png", **scene), PALETTE)


def smaller(path: Path, colors: int) -> bytes:
    """The PNG file with a palette: a third of the size for figures of few colors."""
    from PIL import Image

    # The octree method keeps rare colors, those of single points, and neutral grays; other methods do not.
    stream = io.BytesIO()
    with Image.open(path) as picture:
        picture.convert("RGB").quantize(colors, method=Image.Quantize.FASTOCTREE).save(stream, "PNG", optimize=True)
    return stream.getvalue()


def pictures_of(groups: Sequence[Group], subjects: Any) -> tuple[dict[str, Picture], str]:
    """Pictures by the slugs of the groups, and the reason why pictures are missing, if any."""
    found: dict[str, Picture] = {}
    for group in groups:
        subject = subjects.get(group.subject)
        if subject is None:
            continue
        try:
            picture = error_picture(group, subject)
        except (GeokitError, ImportError) as error:
            return found, f"{type(error).__name__}: {error}"
        if picture is not None:
            found[group.slug] = picture
    return found, ""
