"""C++ source of native kernel functions, kept in ``.inl`` files beside the kernel modules.

A ``.inl`` file holds functions with parameters, one of the name of each function that is declared in Python
(:func:`func_native`) or called by a kernel (:func:`native_item`). Warp puts it within the function that it writes for
the declaration, where C++ has no functions but lambdas: they are ``static constexpr`` and capture nothing, so they may
stand outside of a function too. Compilers thus read each file by itself, with the declarations that ``python -m
tests.sanitize.alone`` writes.

A line ``#include "mesh/bvh/boxes.inl"`` in a file stands for the lines of that file, once where that has
``#pragma once``.
"""

import inspect
import linecache
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import warp as wp

# Types of C++ whose names warp does not have.
_TYPES = {
    "int": int,
    "float": wp.float32,
    "double": wp.float64,
    "unsigned": wp.uint32,
    "long long": wp.int64,
    "unsigned long long": wp.uint64,
    "point": wp.vec3d,
}
_PACKAGE = Path(__file__).resolve().parents[1]


def func_native(
    file: str, *structs: Any, function: str = "", defines: dict[str, str] | None = None, **constants: int | float
) -> Callable[[Callable[..., Any]], wp.Function]:
    """Decorator of a function that calls the C++ function of its name, or of another name, in a file.

    The C++ function has the parameters of the declaration. One that the declaration leaves out has the type that C++
    says, an array there one dimension; what C++ leaves open (``auto``, other arrays, structs) stands in the declaration
    by its C++ name. Structs have their names in Python; those that are in no parameter of the declaration are ``auto``.
    CUDA does not compile what a file that ends in ``_cpu.inl`` holds. Warp looks for a decorator of this name above
    what returns something: write ``@cpp.func_native(...)``.

    Args:
        file: As for :func:`cpp`.
        structs: Structs among the parameters that the declaration leaves out.
        function: Name of the C++ function, if it is not the declaration's.
        defines: As for :func:`cpp`.
        constants: As for :func:`cpp`.
    """

    def declare(declaration: Callable[..., Any]) -> wp.Function:
        _complete(declaration, file, function or declaration.__name__, structs)
        parameters = inspect.signature(declaration).parameters
        types = {name: getattr(parameter.annotation, "key", "") for name, parameter in parameters.items()}
        named = "\n".join(f"using {struct} = decltype({name});" for name, struct in types.items() if struct)
        call = f"return {function or declaration.__name__}({', '.join(parameters)});"
        text = f"\n{named}{cpp(file, defines=defines, **constants)}{call}\n"
        if file.endswith("_cpu.inl"):
            text = f"\n#if !defined(__CUDA_ARCH__){text}#endif\n"
        # Overloads: warp looks for the earlier one among the locals of who calls func_native.
        name, given = declaration.__name__, {"func_native": wp.func_native, "text": text}
        return eval("func_native(text)", given, {name: declaration.__globals__.get(name)})(declaration)

    return declare


def native_item(file: str, function: str, *structs: Any, **given: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorator, below ``wp.kernel``, of a kernel whose items each call a C++ function in a file.

    The C++ function has the parameters of the kernel, with the item in place of ``first``; the kernel may leave out
    others (:func:`func_native`).

    Args:
        file, structs, given: As for :func:`func_native`.
        function: Name of the C++ function.
    """

    def declare(declaration: Callable[..., Any]) -> Any:
        name, module = declaration.__name__, declaration.__globals__
        _complete(declaration, file, function, structs)
        first, *others = inspect.signature(declaration).parameters
        call = f"{name}_item({', '.join([f'{first} + wp.tid()', *others])})"
        text = f"def {name}({', '.join([first, *others])}):\n    {call}\n"
        module[f"{name}_item"] = func_native(file, function=function, **given)(declaration)
        # Warp reads the text of a kernel, which must stand somewhere.
        place = f"<{module['__name__']}.{name}>"
        linecache.cache[place] = len(text), None, text.splitlines(keepends=True), place
        made: dict[str, Any] = {}
        exec(compile(text, place, "exec"), module, made)
        made[name].__annotations__ = declaration.__annotations__
        return made[name]

    return declare


def _complete(declaration: Any, file: str, function: str, structs: tuple[Any, ...]) -> None:
    """Give a declaration the parameters of a C++ function that it leaves out, in the order of that function."""
    own = inspect.signature(declaration)
    head = re.search(rf"^static constexpr auto {function} =\s+\[\]\((.*?)\)", _read(file), re.DOTALL | re.MULTILINE)
    assert head, f"{file}: there is no {function}"
    texts = head[1].split(",")
    if len(texts) == len(own.parameters):
        return
    given = dict(own.parameters)
    parameters = [given.pop("first")] if "first" in given else []
    known = _TYPES | {struct.key: struct for struct in structs}
    for text in texts[len(parameters) :]:
        kind, name = text.replace("const ", "").replace("&", "").strip().rsplit(" ", 1)
        if name not in given:
            inner = kind.removeprefix("wp::array_t<").removesuffix(">")
            found = known.get(inner) or getattr(wp, inner.removeprefix("wp::").removesuffix("_t"))
            annotation = found if inner == kind else wp.array(dtype=found)
            given[name] = inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD, annotation=annotation)
        parameters.append(given.pop(name))
    assert not given, f"{file}: {function} has no parameter {', '.join(given)}"
    # Warp takes the order of the parameters from their annotations.
    types = {parameter.name: parameter.annotation for parameter in parameters}
    declaration.__annotations__ = types | {k: v for k, v in declaration.__annotations__.items() if k == "return"}
    declaration.__signature__ = own.replace(parameters=parameters)


def cpp(file: str, *, defines: dict[str, str] | None = None, **constants: int | float) -> str:
    """The text of a C++ file for ``wp.func_native``.

    Args:
        file: Path relative to the package's folder, such as "volume/rays/raycast_cpu.inl".
        defines: Macros for the file, which are undefined after it.
        constants: Declared as ``constexpr`` before the file. A bool or an int becomes an ``int``, a float a
            ``double``, and a NumPy scalar the C++ type of its width.
    """
    lines = [f"constexpr {_type(value)} {name} = {_literal(value)};" for name, value in constants.items()]
    lines += [f"#define {name} {text}" for name, text in (defines or {}).items()]
    # With #line, compilers and sanitizers report the file and line of the .inl file.
    lines += _expanded(file, set())
    lines += [f"#undef {name.partition('(')[0]}" for name in defines or {}]
    return "\n" + "\n".join(lines) + "\n"


def _expanded(file: str, once: set[str]) -> list[str]:
    if file in once:
        return []
    lines = [f'#line 1 "geokit/{file}"']
    for number, line in enumerate(_read(file).splitlines(), 1):
        name = line.strip().removeprefix("#include ")
        if line.lstrip().startswith('#include "'):
            lines += _expanded(name.strip('"'), once)
            lines.append(f'#line {number + 1} "geokit/{file}"')
        elif line == "#pragma once":
            once.add(file)
            lines.append("")
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
