"""The page of a batch: what was done, what failed and why, and where time and memory went; one HTML file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from geokit.core.files import atomic_path

# Rows of the tables of failures and of slow files; the manifest has all.
MOST = 200
STYLE = """body{font:15px/1.5 system-ui,sans-serif;max-width:70em;margin:2em auto;padding:0 1em;color:#222}
table{border-collapse:collapse;margin:1em 0}td,th{text-align:left;padding:.2em 1em .2em 0;border-bottom:1px solid #ddd;
vertical-align:top}td.n{text-align:right}pre{background:#f4f4f4;padding:1em;overflow:auto}"""


def totals(records: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Counts and sums of a batch."""
    found = list(records.values())
    statuses = Counter(record["status"] for record in found)
    outputs = [output for record in found for output in record.get("outputs", ())]
    return {
        "files": len(found),
        "done": statuses["done"],
        "failed": statuses["failed"],
        "set_aside": statuses["set aside"],
        "outputs": len(outputs),
        "output_bytes": sum(output["bytes"] for output in outputs),
        "input_bytes": sum(record.get("size", 0) for record in found),
        "worker_seconds": round(sum(record.get("seconds", 0.0) for record in found), 3),
        "largest_peak_bytes": max((record.get("peak_bytes", 0) for record in found), default=0),
    }


def write_report(records: Mapping[str, Mapping[str, Any]], recipe: str, path: Path) -> None:
    """Write the page of a batch."""
    failed = [record for _, record in sorted(records.items()) if "error" in record]
    slowest = sorted(records.values(), key=lambda record: -record.get("seconds", 0.0))[:20]
    hosts: dict[str, list[float]] = {}
    for record in records.values():
        if "seconds" in record:
            hosts.setdefault(record["host"], []).append(record["seconds"])
    error_rows = [(record["input"], record["status"], record["error"]["message"]) for record in failed[:MOST]]
    parts = [
        table(("", ""), [(name.replace("_", " "), value) for name, value in totals(records).items()]),
        f"<h2>Failures</h2><p>{len(failed)}{f', of which {MOST} are shown' if len(failed) > MOST else ''}</p>",
        table(("input", "", "error"), error_rows),
        "<h2>Slowest files</h2>",
        table(
            ("input", "seconds", "peak MiB"),
            [(r["input"], r.get("seconds", 0.0), r.get("peak_bytes", 0) >> 20) for r in slowest],
        ),
        "<h2>Machines</h2>",
        table(("host", "files", "seconds"), [(h, len(s), round(sum(s), 2)) for h, s in sorted(hosts.items())]),
        f"<h2>Recipe</h2><pre>{escape(recipe)}</pre>",
    ]
    write_page(path, "Batch", "".join(parts))


def write_page(path: Path, title: str, body: str) -> None:
    """Write a page with a title above its body."""
    title = escape(title)
    page = f"<!doctype html><meta charset=utf-8><title>{title}</title><style>{STYLE}</style><h1>{title}</h1>{body}\n"
    with atomic_path(path) as part:
        part.write_text(page, encoding="utf-8", errors="replace")


def table(heads: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    lines = [
        "<tr>" + "".join(f"<td{' class=n' * (not isinstance(cell, str))}>{_shown(cell)}</td>" for cell in row) + "</tr>"
        for row in rows
    ]
    head = "".join(f"<th>{escape(head)}</th>" for head in heads)
    return f"<table><tr>{head}</tr>{''.join(lines)}</table>" if lines else ""


def _shown(cell: Any) -> str:
    return escape(cell) if isinstance(cell, str) else f"{cell:,}"
