"""What C++ tools need to read a .inl file by itself: ``python -m tests.sanitize.alone``.

That is what warp writes before the file: the structs of its kernels and the constants of its module. They go to a
header for each file in build/alone, with a compile_commands.json that includes it; ``.clangd`` names that folder, so
clangd and ``clang-tidy -p build/alone`` open the file.
"""

from __future__ import annotations

import importlib
import json
import re
from pathlib import Path
from typing import Any

import warp as wp

from tests.sanitize import generated
from tests.sanitize.compiler import LANGUAGE, headers

BUILT = generated.ROOT / "build" / "alone"
# As warp begins what it generates for a CPU; then the constants and hooks of a file, without those of its last lines.
BEGIN = '#pragma once\n#define WP_NO_BFLOAT16\n#define WP_TILE_BLOCK_DIM 1\n#define WP_NO_CRT\n#include "builtin.h"\n'
GIVEN = re.compile(r"^(?:constexpr|#define) .*$", re.MULTILINE)
FUNCTION = re.compile(r"^static constexpr auto \w+ =", re.MULTILINE)


def structure(struct: Any, known: dict[str, str]) -> str:
    """The name of a struct in a .inl file; what declares it, and those that it holds, goes to ``known``."""
    fields = []
    for name, field in struct.vars.items():
        text = field.ctype()
        for part in (field.type, getattr(field.type, "dtype", None)):
            if isinstance(getattr(part, "key", None), str):
                text = text.replace(part.native_name, structure(part, known))
        fields.append(f"    {text} {name};\n")
    known.setdefault(struct.key, f"struct {struct.key} {{\n{''.join(fields)}}};\n")
    return str(struct.key)


def declared() -> dict[str, str]:
    """For each .inl file of functions the text of its header."""
    found: dict[str, str] = {}
    for module in generated.module_names():
        for value in vars(importlib.import_module(module)).values():
            snippet = getattr(value, "native_snippet", None)
            if not isinstance(value, wp.Function) or not snippet:
                continue
            known: dict[str, str] = {}
            for kind in value.input_types.values():
                if isinstance(getattr(kind, "key", None), str):
                    structure(kind, known)
            given = GIVEN.findall(snippet[: snippet.index("#line 1 ")]) if "#line 1 " in snippet else []
            text = "\n".join([BEGIN, *known.values(), *given]) + "\n"
            for region in generated.regions(snippet):
                # A file that several others include is read with what the longest of them is given.
                if FUNCTION.search((generated.ROOT / region.path).read_text(encoding="utf-8")):
                    found[region.path] = max(found.get(region.path, ""), text, key=len)
    return found


def write() -> list[str]:
    """Write headers and commands; returns the files."""
    BUILT.mkdir(parents=True, exist_ok=True)
    commands = []
    found = declared()
    for path, text in sorted(found.items()):
        header = BUILT / (path.removeprefix("geokit/").replace("/", "_").removesuffix(".inl") + ".h")
        header.write_text(text, encoding="utf-8")
        given = ["-include", str(header), "-I", str(generated.PACKAGE), "-isystem", str(headers())]
        arguments = ["clang++", "-x", "c++", *LANGUAGE, "-Wno-pragma-once-outside-header", *given, path]
        commands.append({"directory": str(generated.ROOT), "file": path, "arguments": arguments})
    (BUILT / "compile_commands.json").write_text(json.dumps(commands, indent=1) + "\n", encoding="utf-8")
    return sorted(found)


if __name__ == "__main__":
    print(f"{len(write())} files in {(BUILT / 'compile_commands.json').relative_to(Path.cwd())}")
