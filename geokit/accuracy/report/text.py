"""Formatting of numbers in reports."""

from __future__ import annotations

import math

_TIMES = ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs"), (1e-9, "ns"))
_RATES = ((1e9, " G"), (1e6, " M"), (1e3, " k"))


def seconds_text(seconds: float) -> str:
    """A time with three digits and its unit: "12.3 µs"."""
    seconds = _rounded(seconds)
    size, unit = next(((size, unit) for size, unit in _TIMES if seconds >= size), _TIMES[-1])
    return f"{_three(seconds / size)} {unit}"


def tick_text(seconds: float) -> str:
    """A round time without insignificant digits: "10 µs"."""
    return seconds_text(seconds).replace(".00 ", " ").replace(".0 ", " ")


def rate_text(rate: float) -> str:
    """Answers a second with three digits: "83.1 M"."""
    rate = _rounded(rate)
    size, unit = next(((size, unit) for size, unit in _RATES if rate >= size), (1.0, ""))
    return f"{_three(rate / size)}{unit}"


def bytes_text(count: float) -> str:
    """A size in powers of 1024: "3.2 MiB"."""
    for size, unit in ((1 << 30, "GiB"), (1 << 20, "MiB"), (1 << 10, "KiB")):
        if count >= size:
            return f"{_three(count / size)} {unit}"
    return f"{count:.0f} B"


def error_text(error: float) -> str:
    """An error with three digits; 0 is "exact", a missing error "-"."""
    if math.isnan(error):
        return "-"
    if math.isinf(error):
        return "not finite"
    return "exact" if error == 0.0 else f"{error:.3g}"


def power_text(value: float) -> str:
    """Format a number briefly: "1e-7", "2e-4", "0.01", "1"."""
    text = f"{value:g}" if 1e-3 <= value < 1e4 else f"{value:.0e}"
    return text.replace("e-0", "e-").replace("e+0", "e").replace("e+", "e")


def plain_text(text: str) -> str:
    """Text that matplotlib does not parse as a formula."""
    return text.replace("$", r"\$")


def share_text(share: float) -> str:
    """A share as a percentage, never rounded to 0% or 100%."""
    if share in (0.0, 1.0):
        return f"{share:.0%}"
    return f"{100.0 * share:.3g}%"


def _rounded(value: float) -> float:
    """Round to three significant digits first: a value that rounds up to the next unit is printed in that unit."""
    return float(f"{value:.2e}")


def _three(value: float) -> str:
    """Three significant digits without an exponent."""
    if value == 0.0 or not math.isfinite(value):
        return f"{value:g}"
    digits = max(0, 2 - math.floor(math.log10(abs(value)) + 1e-9))
    return f"{value:.{min(digits, 6)}f}"
