"""The report: one page that needs nothing but itself, its figures and table, and a folder that is never half there."""

from __future__ import annotations

import base64
import dataclasses
import io
import math
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from geokit.accuracy import ChartInfo, Failure, Judgement, Measurement, Results, Subject, read_table, write_report
from geokit.accuracy.report import folder as report
from geokit.accuracy.report.error_figures import chosen_row, error_picture
from geokit.accuracy.report.plot import plot_of
from geokit.accuracy.report.text import bytes_text, error_text, rate_text, seconds_text, share_text, tick_text
from geokit.accuracy.trials.results import grouped
from geokit.errors import FileAccessError, GeokitError, InputError, MissingDependencyError
from geokit.mesh import TriangleMesh

NASTY = "<script>alert('x')</script> & \"quotes\" $x_1$"
TETRAHEDRON = TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
VOID = {"meta", "img", "line", "circle", "polygon", "path", "br"}


def row(method, setting, seconds, error, **others) -> Measurement:
    values = {
        "chart": "closest_point", "subject": "thing.obj", "device": "cpu", "spread": 0.02, "peak_bytes": 1 << 20,
        "byte_count": 5 << 20, "checked": 500, "wrong_share": 0.0, "unit": "world",
    }  # fmt: skip
    values.update(others)
    return Measurement(
        method=method, setting=setting, seconds=seconds, rate=1000.0 / seconds, max_error=error, rms_error=error / 3.0,
        p999_error=error / 2.0, **values,
    )  # fmt: skip


def judgement(errors, wrong=None) -> Judgement:
    positions = np.random.default_rng(0).random((len(errors), 3))
    flags = np.zeros(len(errors), dtype=bool) if wrong is None else np.asarray(wrong)
    return Judgement(np.asarray(errors, dtype=np.float64), flags, positions)


@pytest.fixture(scope="module")
def results() -> Results:
    """Two charts of a mesh, one also on a second device: exact, infinite, wrong and unknown errors, nasty names."""
    rows = [
        row("fast", "size=1", 1e-3, 1e-3, judgement=judgement(np.linspace(0, 1e-3, 50))),
        row("fast", "size=0.5", 3e-3, 1e-5),
        row("slow", NASTY, 2e-2, 0.0),
        row("leaky", "x", 1e-4, 1e-6, wrong_share=0.01),
        row("broken", "x", 1e-4, math.inf),
        row("blind", "x", 1e-4, math.nan, wrong_share=1.0),
        row("fast", "size=1", 1e-5, 1e-3, device="cuda:0"),
        *(row("contains", f"rays={n}", 1e-3 * n, 0.0, chart="sign", wrong_share=0.1 / n**2) for n in (1, 2, 3)),
        row("winding", "", 1e-2, 0.0, chart="sign", judgement=judgement(np.zeros(20), [True] * 2 + [False] * 18)),
    ]
    rows[-1] = dataclasses.replace(rows[-1], wrong_share=0.1, seconds=1e-5, rate=1e8)
    charts = {
        "closest_point": ChartInfo("closest_point", f"Closest point {NASTY}", "world", "queries", "error"),
        "sign": ChartInfo("sign", "Which side", "relative", "queries", "wrong"),
    }
    failures = [Failure("sign", "thing.obj", "cpu", "parity", NASTY, f"RuntimeError: {NASTY}")]
    return Results(
        rows, charts=charts, subjects={"thing.obj": Subject("thing.obj", mesh=TETRAHEDRON)}, failures=failures
    )


@pytest.fixture(scope="module")
def folder(results, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("report") / "new" / "report"
    assert write_report(results, out) == out / "report.html"
    return out


class Page(HTMLParser):
    """Open tags that are closed in order, every attribute, and the text inside each kind of tag."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.attributes: list[tuple[str, str, str]] = []
        self.texts: list[tuple[str, str]] = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.attributes += [(tag, name, value or "") for name, value in attrs]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag, self.getpos()

    def handle_data(self, data):
        if data.strip():
            self.texts.append((self.open[-1], data))


@pytest.fixture(scope="module")
def page(folder) -> Page:
    return Page((folder / "report.html").read_text(encoding="utf-8"))


@pytest.mark.slow
def test_the_files(folder):
    assert {path.name for path in folder.iterdir()} == {"results.csv", "report.html", "figures"}
    names = {path.name for path in (folder / "figures").iterdir()}
    assert names == {"closest_point-thing-obj.png", "sign-thing-obj.png"}
    assert [path.name for path in folder.parent.iterdir()] == ["report"]


def test_the_table_holds_every_row(folder, results):
    again = read_table(folder / "results.csv")
    assert len(again) == len(results)
    for ours, theirs in zip(results, again, strict=True):
        assert repr(dataclasses.replace(ours, parameters={}, judgement=None)) == repr(
            dataclasses.replace(theirs, parameters={})
        )


def test_the_page_refers_to_nothing_outside(folder, page):
    for tag, name, value in page.attributes:
        if name in ("src", "href", "xlink:href", "srcset", "data", "action", "poster"):
            assert value.startswith(("#", "data:image/png;base64,")), (tag, name, value[:80])
        assert not name.startswith("on"), (tag, name)
    text = (folder / "report.html").read_text(encoding="utf-8")
    assert set(re.findall(r"https?://[^\"' <]*", text)) == {"http://www.w3.org/2000/svg"}
    assert "@import" not in text
    assert "url(" not in text
    targets = {value[1:] for _, name, value in page.attributes if name == "href"}
    identifiers = [value for _, name, value in page.attributes if name == "id"]
    assert targets <= set(identifiers)
    assert len(set(identifiers)) == len(identifiers)


@pytest.mark.slow
def test_text_is_escaped(page):
    # Parsed as a tag it would not be text; the page's own script is the only one.
    assert [tag for tag, _ in page.texts].count("script") == 1
    assert any(NASTY in data for tag, data in page.texts if tag == "td")
    assert any(NASTY in data for tag, data in page.texts if tag == "h2")
    assert any(NASTY in data for tag, data in page.texts if tag == "title")


def test_every_row_is_in_the_last_table_and_its_mark_says_so(folder, page, results):
    text = (folder / "report.html").read_text(encoding="utf-8")
    table = Page("<body>" + text[text.index('<section id="rows">') : text.index('<div id="tip"')] + "</body>")
    cells = [data for tag, data in table.texts if tag == "td"]
    for found in results:
        assert cells.count(found.method) == sum(other.method == found.method for other in results)
        assert found.setting in cells or not found.setting
    tips = [data for tag, data in page.texts if tag == "title"]
    drawn = [found for found in results if not math.isnan(found.max_error)]
    assert len(tips) == len(drawn) + 1  # and the page's
    for found in drawn:
        assert any(tip.startswith(f"{found.method}\n{found.setting}") for tip in tips), found


def test_tolerances_that_lead_to_one_setting_are_one_line(page):
    cells = [data for tag, data in page.texts if tag == "td"]
    for limit, setting in (("0.0001 to 1e-05", "size=0.5"), ("1e-06 to exact", NASTY)):
        assert cells[cells.index(limit) + 2] == setting


def test_what_cannot_be_drawn_or_measured_is_said(page):
    paragraphs = [data for tag, data in page.texts if tag in ("p", "li")]
    assert any("Every answer wrong" in data and "blind" in data for data in paragraphs)
    assert any("parity" in data and "failed: RuntimeError" in data for data in paragraphs)


def test_the_page_names_machine_and_versions(page):
    names = [data for tag, data in page.texts if tag == "dt"]
    assert {"processor", "cores", "system", "date", "geokit", "python", "warp", "numpy", "OpenVDB"} <= set(names)


def test_pictures_are_small_and_show_the_wrong_answers(page):
    from matplotlib.image import imread

    images = [value.partition(",")[2] for tag, name, value in page.attributes if (tag, name) == ("img", "src")]
    assert len(images) == 2
    files = [base64.b64decode(image) for image in images]
    assert all(1000 < len(data) < 60_000 for data in files)
    # The second is of the chart of signs: two orange points on gray.
    pixels = imread(io.BytesIO(files[1]), format="png")[..., :3]
    orange = (pixels[..., 0] - pixels[..., 2] > 0.35).sum()
    assert 20 < orange < 2000
    captions = [data for tag, data in page.texts if tag == "figcaption"]
    assert any("the 2 wrong answers of 20" in caption for caption in captions)
    assert any("50 of 50 checked answers" in caption for caption in captions)


def test_figures_have_the_floor_and_the_front(folder):
    from matplotlib.image import imread

    for path in (folder / "figures").iterdir():
        pixels = imread(path)
        assert pixels.shape[0] >= 560
        assert pixels.shape[1] == 1060
        assert path.stat().st_size < 200_000
        assert (pixels[..., :3].min(axis=-1) < 0.5).mean() > 0.005


# Where marks stand.


def test_the_plot(results):
    groups = grouped(results)
    assert [(group.chart.name, group.slug) for group in groups] == [
        ("closest_point", "closest_point-thing-obj"),
        ("sign", "sign-thing-obj"),
    ]
    plot = plot_of(groups[0])
    assert [mark.letter for mark in plot.marks] == ["A", "B", "C", "", "", "D"]
    assert plot.floor == pytest.approx(1e-7)
    assert plot.ceiling == pytest.approx(1e-2)
    assert {mark.row.method: mark.y for mark in plot.marks}["slow"] == plot.floor
    assert {mark.row.method: mark.y for mark in plot.marks}["broken"] == plot.ceiling
    assert [mark.row.method for mark in plot.marks if mark.hollow] == ["leaky"]
    assert plot.y_ticks == [1e-6, 1e-5, 1e-4, 1e-3]
    assert [found.method for found in plot.left_out] == ["blind"]
    assert (plot.x_label, plot.y_label) == ("time per query", "largest error [world]")
    for ends, values in ((plot.x_range, [m.x for m in plot.marks]), (plot.y_range, [m.y for m in plot.marks])):
        assert ends[0] < min(values) <= max(values) < ends[1]
    signs = plot_of(groups[1])
    assert signs.y_label == "share of wrong answers"
    assert signs.floor is None
    assert not any(mark.hollow for mark in signs.marks)


def test_a_plot_of_exact_answers_only():
    plot = plot_of(grouped([row("a", "", 1.0, 0.0), row("b", "", 2.0, 0.0)])[0])
    assert plot.floor == pytest.approx(1e-16)
    assert plot.y_ticks == []  # the height of the floor is no value
    assert [mark.letter for mark in plot.marks] == ["A", ""]
    assert plot.y_range[0] < plot.floor < plot.y_range[1]


@pytest.mark.slow
def test_rows_that_were_read_know_what_their_chart_shows(results, tmp_path):
    out = write_report(list(results), tmp_path / "again")
    assert out.is_file()
    groups = grouped(read_table(tmp_path / "again" / "results.csv"))
    assert [group.chart.vertical for group in groups] == ["error", "wrong"]
    assert groups[0].chart.title == "closest point"


def test_names_that_look_alike_get_files_of_their_own():
    rows = [row("a", "", 1.0, 1.0, subject=name) for name in ("a.b", "a b", "A-B", "形")]
    slugs = [group.slug for group in grouped(rows)]
    assert len(set(slugs)) == 4
    assert all(re.fullmatch(r"[a-z0-9_-]+", slug) for slug in slugs)


# Pictures.


def test_the_picture_is_of_the_knee_or_of_the_worst(results):
    groups = grouped(results)
    assert chosen_row(groups[0]).setting == "size=1"
    assert chosen_row(groups[1]).method == "winding"
    silent = grouped([row("a", "", 1.0, 0.0, judgement=judgement(np.zeros(5)))])[0]
    assert chosen_row(silent) is None
    assert error_picture(silent, Subject("thing.obj", mesh=TETRAHEDRON)) is None
    rows = [
        row("a", "", 1.0, 0.0, judgement=judgement(np.zeros(5))),
        row("b", "", 2.0, 1.0, judgement=judgement(np.ones(5))),
    ]
    assert chosen_row(grouped(rows)[0]).method == "b"


@pytest.mark.slow
def test_without_opengl_the_page_says_so(results, tmp_path, monkeypatch):
    def refuse(*arguments, **options):
        raise MissingDependencyError("off-screen figures need EGL")

    monkeypatch.setattr("geokit.render.figure", refuse)
    text = write_report(results, tmp_path / "report").read_text(encoding="utf-8")
    assert "data:image/png" not in text
    assert "MissingDependencyError: off-screen figures need EGL" in text


# The folder.


def test_a_folder_that_is_not_empty_is_refused(results, tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(InputError, match="not empty"):
        write_report(results, tmp_path, pictures=False)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]
    with pytest.raises(FileAccessError, match="is a file"):
        write_report(results, tmp_path / "mine.txt")
    with pytest.raises(InputError, match="nothing to report"):
        write_report([], tmp_path / "report")


@pytest.mark.slow
def test_force_replaces_the_report_and_nothing_else(results, tmp_path):
    out = tmp_path / "report"
    write_report(results, out, pictures=False)
    (out / "mine.txt").write_text("mine")
    (out / "figures" / "mine.png").write_text("mine")
    before = {path.stem for path in (out / "figures").iterdir()}
    write_report(results, out, pictures=False, force=True, figure_format="svg")
    assert {path.name for path in (out / "figures").iterdir()} == {
        f"{stem}.{'png' if stem == 'mine' else 'svg'}" for stem in before
    }
    fewer = Results([found for found in results if found.chart == "sign"], charts=results.charts)
    write_report(fewer, out, pictures=False, force=True)
    assert {path.name for path in out.iterdir()} == {"results.csv", "report.html", "figures", "mine.txt"}
    assert {path.name for path in (out / "figures").iterdir()} == {"sign-thing-obj.png", "mine.png"}
    assert len(read_table(out / "results.csv")) == 4
    assert [path.name for path in tmp_path.iterdir()] == ["report"]


def test_an_empty_folder_is_filled(tmp_path):
    (tmp_path / "report").mkdir()
    write_report([row("a", "", 1.0, 1.0)], tmp_path / "report")
    assert {path.name for path in (tmp_path / "report").iterdir()} == {"results.csv", "report.html", "figures"}


@pytest.mark.slow
@pytest.mark.parametrize(
    "error", [RuntimeError("half way"), KeyboardInterrupt(), OSError(28, "No space left on device")]
)
def test_a_report_that_fails_leaves_nothing(tmp_path, monkeypatch, error):
    out, results = tmp_path / "report", [row("a", "", 1.0, 1.0)]
    write_report(results, out, pictures=False)
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}

    def fail(*arguments, **options):
        raise error

    monkeypatch.setattr(report, "page", fail)
    wanted = FileAccessError if isinstance(error, OSError) else type(error)
    for target, force in ((tmp_path / "new", False), (out, True)):
        with pytest.raises(wanted):
            write_report(results, target, pictures=False, force=force)
    assert [path.name for path in tmp_path.iterdir()] == ["report"]
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before


def test_a_folder_where_none_can_be_made(results, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(GeokitError):
        write_report(results, tmp_path / "file" / "report", pictures=False)


# Figures and numbers.


def test_figures_have_a_format_that_matplotlib_writes(results, tmp_path):
    with pytest.raises(InputError, match="figure_format"):
        write_report(results, tmp_path / "report", pictures=False, figure_format="jpg")
    assert list(tmp_path.iterdir()) == []


def test_numbers_as_text():
    assert [seconds_text(s) for s in (2.0, 0.0123, 1.5e-6, 3.21e-8, 4e-11)] == [
        "2.00 s", "12.3 ms", "1.50 µs", "32.1 ns", "0.0400 ns",
    ]  # fmt: skip
    assert seconds_text(0.0009999) == "1.00 ms"
    assert [tick_text(s) for s in (1e-8, 1e-5, 2.0)] == ["10 ns", "10 µs", "2 s"]
    assert [rate_text(r) for r in (83.1e6, 1.5e9, 20.0, 999.9e3)] == ["83.1 M", "1.50 G", "20.0", "1.00 M"]
    assert [bytes_text(b) for b in (12, 2048, 3 << 20, 5 << 30)] == ["12 B", "2.00 KiB", "3.00 MiB", "5.00 GiB"]
    assert [error_text(e) for e in (0.0, math.inf, math.nan, 1.2345e-7)] == ["exact", "not finite", "-", "1.23e-07"]
    # A few wrong answers of many are neither none nor is nearly all of them all.
    assert [share_text(s) for s in (0.0, 1.0, 1e-7, 0.25)] == ["0%", "100%", "1e-05%", "25%"]
