"""Recipes are refused before a file is read: which line, which step, which key."""

from __future__ import annotations

from pathlib import Path

import pytest

from geokit.cli._batches.recipe import is_made, names_of, output_name, output_names, read_recipe
from geokit.errors import FileAccessError, InputError

GOOD = """\
[[step]]
verb = "convert"
output = "{folder}/{stem}.nvdb"
voxel_size = 0.05
codec = "fp8,zip"
keep = false

[[step]]
verb = "volume offset"
output = "{stem}.vdb"
distance = -0.1

[[step]]
verb = "query closest"
files = ["{input}", "points.csv"]
output = "{stem}.csv"
finite-only = false

[[step]]
verb = "mesh transform"
files = ["{input}"]
output = "{stem}.ply"
move = [1, 2.5, 3]

[[step]]
verb = "info"
files = ["{step1}"]

[[step]]
verb = "bench"
files = ["{input}"]
output = "bench-{stem}"
chart = ["a", "b"]
quick = true
"""


def _read(folder: Path, text: str):
    path = folder / "recipe.toml"
    path.write_text(text)
    return read_recipe(path)


def test_steps_become_command_lines(tmp_path: Path) -> None:
    points = tmp_path / "points.csv"
    points.write_text("x,y,z\n0,0,0\n")
    recipe = _read(tmp_path, GOOD)
    names = {**names_of(Path("/data/run/a.obj")), "previous": "PREVIOUS", "step1": "ONE"}
    lines = [step.words(names, step.output and "OUT") for step in recipe.steps]
    assert lines == [
        ["convert", "--voxel-size=0.05", "--codec=fp8,zip", "--json", "PREVIOUS", "OUT"],
        ["volume", "offset", "--distance=-0.1", "--json", "PREVIOUS", "OUT"],
        ["query", "closest", "--no-finite-only", "--json", "--output=OUT", "/data/run/a.obj", str(points)],
        ["mesh", "transform", "--move", "1", "2.5", "3", "--json", "/data/run/a.obj", "OUT"],
        ["info", "--json", "ONE"],
        ["bench", "--chart=a", "--chart=b", "--quick", "--json", "--out=OUT", "/data/run/a.obj"],
    ]
    assert output_names(recipe, Path("/data/run/a.obj")) == ["a.vdb", "a.csv", "a.ply", "bench-a"]


@pytest.mark.slow
def test_the_hash_is_of_the_steps_and_of_their_files(tmp_path: Path) -> None:
    (tmp_path / "points.csv").write_text("x,y,z\n0,0,0\n")
    first = _read(tmp_path, GOOD).hash
    assert _read(tmp_path, "# told\n" + GOOD).hash == first
    assert _read(tmp_path, GOOD.replace("0.05", "0.06")).hash != first
    (tmp_path / "points.csv").write_text("x,y,z\n0,0,1\n")
    assert _read(tmp_path, GOOD).hash != first


STEP = '[[step]]\nverb = "volume offset"\noutput = "{stem}.vdb"\ndistance = 1\n'


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[[step]\n", ["recipe.toml: is not TOML", "line 1"]),
        ("", ["there are no steps", "[[step]]"]),
        ("step = 3\n", ["there are no steps"]),
        ("name = 'a'\n" + STEP, ["name: unknown", "[[step]]"]),
        (STEP + "[[step]]\noutput = 'a'\n", ["recipe.toml:5: step 2: verb: is missing", "convert"]),
        (STEP.replace("volume offset", "remove"), ["recipe.toml:2: step 1: verb: 'remove'", "convert"]),
        (STEP.replace("volume offset", "volume ofset"), [":2: step 1 (volume ofset)", "'volume ofset'", "offset"]),
        (STEP.replace("volume offset", "volume"), [":2: ", "'volume' is no command", "offset"]),
        (STEP.replace("volume offset", "view"), [":2: ", "'view' is no command of a batch"]),
        (
            STEP + "distanc = 2\n",
            [":5: step 1 (volume offset): distanc: Unknown option: --distanc", "mean --distance?", "--help"],
        ),
        (STEP.replace("= 1", "= 'far'"), [":4: step 1 (volume offset): distance: ", "far"]),
        (STEP.replace("distance = 1\n", ""), [":1: step 1 (volume offset): ", "--distance"]),
        (STEP.replace("= 1", "= {a = 1}"), [":4: ", "distance: write a number"]),
        (STEP + "force = true\n", [":5: ", "force: a batch sets it itself"]),
        (STEP + "keep = 1\n", [":5: ", "keep: write true or false"]),
        (STEP + "files = 'a'\n", [":5: ", "files: write a list"]),
        (STEP + "files = ['none.vdb']\n", [":5: ", "none.vdb: no such file"]),
        (STEP + "files = ['{step1}']\n", [":5: ", "{step1}", "unknown", "{previous}"]),
        (STEP.replace("{stem}", "a"), [":3: ", "the same for all files", "{stem}"]),
        (STEP.replace("{stem}", "{steam}{stem}"), [":3: ", "placeholder", "{folder}"]),
        (STEP.replace("{stem}", "../{stem}"), [":3: ", "leads out"]),
        (STEP.replace("{stem}", "/{stem}"), [":3: ", "leads out"]),
        (STEP.replace("{stem}", ".{stem}"), [":3: ", "is hidden"]),
        (STEP.replace('output = "{stem}.vdb"', ""), [":1: ", "output: name what the step makes"]),
        (STEP + STEP, ["two steps have the output '{stem}.vdb'"]),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, text: str, words: list[str]) -> None:
    with pytest.raises(InputError) as error:
        _read(tmp_path, text)
    for word in words:
        assert word in str(error.value)


def test_a_recipe_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(FileAccessError, match="no such file"):
        read_recipe(tmp_path / "none.toml")


@pytest.mark.parametrize(
    ("output", "source", "reason"),
    [
        ("{folder}/{stem}.ply", "/a.obj", "leads out"),
        ("{stem}/mesh.ply", "/in/...obj", "leads out"),
        ("x/{folder}/mesh.ply", "/in/../a.obj", "leads out"),
        ("{stem}/mesh.ply", "/in/.geokit-batch.obj", "is hidden"),
        ("{stem}.ply", "/in/.a.obj", "is hidden"),
        ("{stem}.html", "/in/report.glb", "is a file of the batch itself"),
        ("{stem}.tsv", "/in/Failures-3-of-64.ply", "is a file of the batch itself"),
        ("{stem}.jsonl", "/in/manifest.ply", "is a file of the batch itself"),
    ],
)
def test_a_file_may_not_name_an_output_that_is_none(tmp_path: Path, output: str, source: str, reason: str) -> None:
    with pytest.raises(InputError) as error:
        output_name(output, names_of(Path(source)))
    for word in (f"{source}: its output would be ", reason, "rename the file", repr(output)):
        assert word in str(error.value)
    recipe = _read(tmp_path, f'[[step]]\nverb = "convert"\noutput = "{output}"\n')
    assert output_names(recipe, Path(source)) is None
    assert output_names(recipe, Path("/in/b.obj")) == [output.format(stem="b", folder="in")]


def test_what_counts_as_the_output_of_a_step() -> None:
    for files in (["a/b.ply"], ["a/b.ply/c"], ["x", "a/b-03.ply"]):
        assert is_made("a/b.ply", files)
    for files in ([], ["b.ply"], ["a/b.png"], ["a/bc.ply"], ["a/c/b.ply"]):
        assert not is_made("a/b.ply", files)


def test_names_of_files_of_a_recipe_may_hold_braces(tmp_path: Path) -> None:
    folder = tmp_path / "{x}"
    folder.mkdir()
    points = folder / "p{}.csv"
    points.write_text("x,y,z\n0,0,0\n")
    text = '[[step]]\nverb = "query closest"\nfiles = ["{input}", "p{{}}.csv"]\noutput = "{stem}.csv"\n'
    recipe = _read(folder, text)
    assert recipe.steps[0].words({"input": "a.obj"}, None)[-2:] == ["a.obj", str(points)]
    points.write_text("x,y,z\n0,0,1\n")
    assert _read(folder, text).hash != recipe.hash
