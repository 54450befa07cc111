"""Recipes: the commands that a batch runs for each file, as TOML; checked before the first file is read."""

from __future__ import annotations

import contextlib
import hashlib
import inspect
import json
import re
import sys
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

from geokit._packages import require_package
from geokit.cli._program.app import GROUPS, VERBS, build_commands
from geokit.cli._program.run import usage_message
from geokit.core.files import in_one_line, require_file
from geokit.errors import InputError

# Verbs of people at a terminal, or without a file.
LEFT_OUT = ("view", "guide", "doctor", "demo", "batch")
STEP_VERBS = tuple(verb for verb in VERBS if verb not in LEFT_OUT)
OWN_KEYS = ("verb", "files", "output", "keep")
# Options of all commands, which the command itself does not know.
GLOBAL = ("memory-limit", "reference-folder", "cad-tolerance")
# What a batch sets itself.
SET_HERE = ("json", "force", "out", "jobs", "out-dir", "to")
# Placeholders of a name that the batch makes.
NAMING = ("stem", "folder")
# Files that the batch writes itself.
_OWN = re.compile(r"(manifest|failures|report)(-\d+-of-\d+)?\.(jsonl|tsv|html)", re.IGNORECASE)


@dataclass(frozen=True)
class Step:
    """A command that runs for each file.

    Attributes:
        verb: As on the command line: "convert", "volume offset".
        options: Words after the verb.
        files: What it reads, with placeholders.
        output: What it makes, with placeholders; None if it only prints.
        place: How the command takes its output: "--output", "--out", or "" for its last file.
        keep: Whether the output stays, or is only for later steps.
    """

    verb: str
    options: tuple[str, ...]
    files: tuple[str, ...]
    output: str | None
    place: str
    keep: bool

    def words(self, names: Mapping[str, str], target: str | None) -> list[str]:
        """The command line for one file."""
        files = [file.format_map(names) for file in self.files]
        if target is not None:
            files = [*files, target] if not self.place else [f"{self.place}={target}", *files]
        return [*self.verb.split(), *self.options, *files]


@dataclass(frozen=True)
class Recipe:
    """The steps, their text, and a hash of both and of the files that they name."""

    steps: tuple[Step, ...]
    text: str
    hash: str


def read_recipe(path: Path) -> Recipe:
    """Read and check a recipe.

    Raises:
        FileAccessError: The recipe cannot be read.
        InputError: It is no TOML, or a step is not a command line; the message names line, step and key.
    """
    try:
        text = require_file(path).read_text(encoding="utf-8")
        found = _toml().loads(text)
    except (ValueError, RecursionError) as error:  # TOMLDecodeError names the line
        raise InputError(f"{path}: is not TOML: {in_one_line(str(error))}; mend that line") from error
    steps = found.get("step")
    if set(found) != {"step"} or not isinstance(steps, list) or not all(isinstance(step, dict) for step in steps):
        other = ", ".join(sorted(set(found) - {"step"}))
        raise InputError(
            f"{path}: {f'{other}: unknown' if other else 'there are no steps'}; write [[step]] tables only"
        )
    read = tuple(_Reader(path, text, number + 1).read(step) for number, step in enumerate(steps))
    outputs = [step.output for step in read if step.output]
    for step, output in enumerate(outputs):
        if output in outputs[:step]:
            raise InputError(f"{path}: two steps have the output {output!r}; give each a name of its own")
    digest = hashlib.sha256(json.dumps([asdict(step) for step in read], sort_keys=True).encode())
    for file in sorted({name for step in read for file in step.files if (name := _literal(file)) is not None}):
        digest.update(hashlib.sha256(Path(file).read_bytes()).digest())
    return Recipe(read, text, digest.hexdigest())


def names_of(source: Path) -> dict[str, str]:
    """What the placeholders of names stand for."""
    return {"stem": source.stem, "folder": source.parent.name, "input": str(source)}


def output_names(recipe: Recipe, source: Path) -> list[str] | None:
    """Names of the files that stay, relative to the folder of the batch; None if this file fails for its name."""
    names = names_of(source)
    with contextlib.suppress(InputError):
        return [output_name(step.output, names) for step in recipe.steps if step.output and step.keep]
    return None


def output_name(output: str, names: Mapping[str, str]) -> str:
    """The name of an output, relative to the folder of the batch: names of files come from anybody.

    Raises:
        InputError: The name leads out of that folder, is hidden, or is one of the batch's own.
    """
    name = output.format_map(names)
    reason = refusal_of(name)
    if reason:
        raise InputError(
            f"{names['input']}: its output would be {name!r}, which {reason}; rename the file, or change {output!r} in "
            "the recipe"
        )
    return str(PurePosixPath(name))


def is_made(name: str, files: Iterable[str]) -> bool:
    """Whether an output is among files: itself, files in it, or its numbered pieces (mesh split)."""
    path = PurePosixPath(name)
    piece = str(path.with_name(f"{path.stem}-"))
    return any(
        file == name or file.startswith(f"{name}/") or (file.startswith(piece) and file.endswith(path.suffix))
        for file in files
    )


def refusal_of(name: str) -> str:
    """Why an output cannot have a name; "" if it can."""
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or not path.parts:
        return "leads out of the folder of the batch"
    if any(part.startswith(".") for part in path.parts):
        return "is hidden, as it begins with a dot"
    return "is a file of the batch itself" if _OWN.fullmatch(str(path)) else ""


def _literal(file: str) -> str | None:
    """The name of a file of the recipe; None if a placeholder is in it."""
    try:
        return file.format_map({})
    except LookupError:
        return None


class _Reader:
    def __init__(self, path: Path, text: str, number: int) -> None:
        self.path, self.lines, self.number, self.verb = path, text.split("\n"), number, ""

    def refusal(self, key: str, message: str) -> InputError:
        """The error of a key: tomllib does not say where a value stood, so its line is looked for."""
        starts = [row for row, line in enumerate(self.lines) if re.match(r"\s*\[\[\s*['\"]?step['\"]?\s*\]\]", line)]
        place = f"{self.path}"
        if len(starts) >= self.number:
            first = starts[self.number - 1]
            last = (*starts, len(self.lines))[self.number]
            named = re.compile(rf"\s*['\"]?{re.escape(key)}['\"]?\s*=") if key else re.compile("(?!)")
            rows = [row for row in range(first, last) if named.match(self.lines[row])]
            place = f"{self.path}:{(rows or [first])[0] + 1}"
        step = f"step {self.number}" + (f" ({self.verb})" if self.verb else "")
        return InputError(f"{place}: {step}: {f'{key}: ' if key else ''}{message}")

    def read(self, table: dict[str, Any]) -> Step:
        function = self._command(table.get("verb"))
        parameters = inspect.signature(function).parameters
        place = "--output" if "output" in parameters else "--out" if "out" in parameters else ""
        files, output = self._files(table), table.get("output")
        self._check_output(output, needed="target" in parameters or "files" in parameters)
        keep = table.get("keep", True)
        if not isinstance(keep, bool):
            raise self.refusal("keep", "write true or false")
        options = {key.replace("_", "-"): (key, value) for key, value in table.items() if key not in OWN_KEYS}
        words: list[str] = []
        for option, (key, value) in options.items():
            if option in SET_HERE or option == place[2:]:
                raise self.refusal(key, "a batch sets it itself; leave it out, and name what the step makes by output")
            words += self._words(option, key, value, parameters)
        step = Step(self.verb, tuple(words), files, output, place, keep)
        self._parse(step, options, [])
        # Commands that print a summary as JSON do so, for the manifest.
        with contextlib.suppress(InputError):
            self._parse(step, options, ["--json"])
            return replace(step, options=(*words, "--json"))
        return step

    def _command(self, verb: Any) -> Any:
        if not isinstance(verb, str) or not verb.split() or verb.split()[0] not in STEP_VERBS:
            said = "is missing" if verb is None else f"{verb!r} is no command of a batch"
            raise self.refusal("verb", f"{said}; use one of {', '.join(STEP_VERBS)}")
        self.verb = " ".join(verb.split())
        _, apps, unused = build_commands().parse_commands(self.verb.split())
        if unused or apps[-1].default_command is None:
            group = self.verb.split()[0] in GROUPS
            known = ", ".join(sorted(name for name in apps[-1] if not name.startswith("-"))) if group else ""
            raise self.refusal("verb", f"{self.verb!r} is no command" + (f"; use one of {known}" if known else ""))
        return apps[-1].default_command

    def _files(self, table: dict[str, Any]) -> tuple[str, ...]:
        files = table.get("files", ["{previous}"])
        if not isinstance(files, list) or not all(isinstance(file, str) for file in files):
            raise self.refusal("files", 'write a list of names, as in ["{input}", "points.csv"]')
        steps = {f"step{number}": "" for number in range(1, self.number)}
        names = dict.fromkeys(("input", "previous", *NAMING), "") | steps
        found = []
        for file in files:
            self._fill("files", file, names)
            name = _literal(file)
            if name is not None:
                name = str(Path(self.path.parent, name).absolute())
                if not Path(name).is_file():
                    raise self.refusal("files", f"{name}: no such file; names are relative to the recipe's folder")
                file = name.replace("{", "{{").replace("}", "}}")
            found.append(file)
        return tuple(found)

    def _check_output(self, output: Any, needed: bool) -> None:
        if output is None and not needed:
            return
        if not isinstance(output, str):
            raise self.refusal("output", 'name what the step makes, as in "{stem}.nvdb"')
        if not any(f"{{{name}}}" in output for name in NAMING):
            raise self.refusal("output", f"{output!r} is the same for all files; write {{stem}} or {{folder}} into it")
        reason = refusal_of(self._fill("output", output, dict.fromkeys(NAMING, "a")))
        if reason:
            raise self.refusal("output", f"{output!r} {reason}; use another name, inside it")

    def _fill(self, key: str, text: str, names: dict[str, str]) -> str:
        try:
            return text.format_map(names)
        except (LookupError, ValueError, AttributeError) as error:
            known = ", ".join(f"{{{name}}}" for name in names)
            raise self.refusal(key, f"{text!r} has a placeholder that is unknown here; use {known}") from error

    def _words(self, option: str, key: str, value: Any, parameters: Mapping[str, inspect.Parameter]) -> list[str]:
        if isinstance(value, bool):
            return [f"--{option}" if value else f"--no-{option}"]
        values = value if isinstance(value, list) else [value]
        if not all(isinstance(item, (str, int, float)) and not isinstance(item, bool) for item in values):
            raise self.refusal(key, "write a number, a text, true, false, or a list of numbers or texts")
        found = parameters.get(option.replace("-", "_"))
        if found is not None and any(kind in str(found.annotation) for kind in ("Point", "tuple")):
            return [f"--{option}", *map(str, values)]
        return [f"--{option}={item}" for item in values]

    def _parse(self, step: Step, options: dict[str, tuple[str, Any]], more: list[str]) -> None:
        line = step.words(_Anything(), "output" if step.output else None)
        line = [*(word for word in line if word[2:].partition("=")[0] not in GLOBAL), *more]
        try:
            build_commands().parse_args(line, exit_on_error=False, print_error=False)
        except require_package("cyclopts").CycloptsError as error:
            message = " ".join(usage_message(error).split()).rstrip(".")
            wrong = message.partition("Did you mean")[0]
            keys = [key for option, (key, _) in options.items() if re.search(rf"--{re.escape(option)}(?![\w-])", wrong)]
            raise self.refusal(keys[0] if keys else "", f"{message}; geokit {self.verb} --help lists all") from error


class _Anything(dict[str, str]):
    def __missing__(self, key: str) -> str:
        return "input"


def _toml() -> Any:
    if sys.version_info >= (3, 11):
        import tomllib

        return tomllib
    import tomli

    return tomli
