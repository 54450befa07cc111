"""C++ of native kernel functions, kept in files of its own beside the kernel modules.

A ``.inl`` file holds statements of a function body: warp writes the function's head and the braces around them. Its
first comment says which names it expects in scope and what it defines. Files that are put together share one scope.

A line ``#include "mesh/bvh/boxes.inl"`` in a file stands for the lines of that file; ``#include NAME`` for those of the
file that ``defines`` gives a name: a hook of more than a line.
"""

from functools import cache
from pathlib import Path

__all__ = ["cpp"]

_PACKAGE = Path(__file__).resolve().parents[1]


def cpp(*files: str, defines: dict[str, str] | None = None, **constants: int | float) -> str:
    """Text of C++ files for ``wp.func_native``, one after the other.

    Args:
        files: Paths from the package's folder, as "mesh/bvh/nearest_bvh8_cpu.inl".
        defines: Macros for these files, undefined again behind them: hooks, and names of types.
        constants: Become ``constexpr``: a bool or an int an ``int``, a float a ``double``, a NumPy scalar the C++ type
            of its width. Declared once, before the first file.
    """
    lines = [f"constexpr {_type(value)} {name} = {_literal(value)};" for name, value in constants.items()]
    lines += [f"#define {name} {text}" for name, text in (defines or {}).items()]
    for file in files:
        # Compilers and sanitizers then name the file and its line.
        lines += _expanded(file, defines or {})
    lines += [f"#undef {name.partition('(')[0]}" for name in defines or {}]
    return "\n" + "\n".join(lines) + "\n"


def _expanded(file: str, defines: dict[str, str]) -> list[str]:
    lines = [f'#line 1 "geokit/{file}"']
    for number, line in enumerate(_read(file).splitlines(), 1):
        name = line.strip().removeprefix("#include ")
        # A hook without a file stays as it is, for behind #ifdef.
        if line.lstrip().startswith("#include ") and (name in defines or name.startswith('"')):
            lines += _expanded(defines.get(name, name).strip('"'), defines)
            lines.append(f'#line {number + 1} "geokit/{file}"')
        else:
            lines.append(line)
    return lines


@cache
def _read(file: str) -> str:
    return (_PACKAGE / file).read_text(encoding="utf-8").rstrip("\n")


def _type(value: int | float) -> str:
    size = getattr(value, "itemsize", None)
    if isinstance(value, float) or getattr(value, "dtype", None) == "float32":
        return "float" if size == 4 else "double"
    return "long long" if size == 8 else "int"


def _literal(value: int | float) -> str:
    if _type(value) in ("float", "double"):
        text = repr(float(str(value)))
        return text + "f" if _type(value) == "float" else text
    return str(int(value))
