"""C++ source of native kernel functions, kept in ``.inl`` files beside the kernel modules.

A ``.inl`` file holds the statements of a function body; warp adds the function's signature and braces. The first
comment of a file lists the names that it expects in scope and those that it defines. Concatenated files share a scope.

A line ``#include "mesh/bvh/boxes.inl"`` in a file stands for the lines of that file; ``#include NAME`` for those of the
file that ``defines`` gives a name: a hook of more than a line.
"""

from functools import cache
from pathlib import Path

__all__ = ["cpp"]

_PACKAGE = Path(__file__).resolve().parents[1]


def cpp(*files: str, defines: dict[str, str] | None = None, **constants: int | float) -> str:
    """Concatenate C++ files into one text for ``wp.func_native``.

    Args:
        files: Paths relative to the package's folder, such as "mesh/bvh/nearest_bvh8_cpu.inl".
        defines: Macros for these files (hooks, type names); they are undefined after the last file.
        constants: Declared as ``constexpr`` before the first file. A bool or an int becomes an ``int``, a float a
            ``double``, and a NumPy scalar the C++ type of its width.
    """
    lines = [f"constexpr {_type(value)} {name} = {_literal(value)};" for name, value in constants.items()]
    lines += [f"#define {name} {text}" for name, text in (defines or {}).items()]
    for file in files:
        # With #line, compilers and sanitizers report the file and line of the .inl file.
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
