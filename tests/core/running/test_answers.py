"""Answers of a process on its standard output, whatever libraries print there."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from geokit.cli import _compile, _latency, doctor

PRINTING = """
import ctypes, os, sys
from geokit.core.running.answers import take_stdout
answers = take_stdout()
print("printed by Python", flush=True)
os.write(1, b"written to the handle\\n")
ctypes.CDLL(None).puts(b"printed by C")
ctypes.CDLL(None).fflush(None)
answers.write('{"one": "\\u00e9"}\\n')
"""
# Prints as soon as anything imports the module that the process is started for.
NOISE = """
import os, sys
def hook(event, arguments):
    if event == "import" and arguments[0] == {module!r}:
        os.write(1, b"noise\\n")
sys.addaudithook(hook)
"""


def test_only_answers_go_to_the_standard_output():
    done = subprocess.run([sys.executable, "-c", PRINTING], capture_output=True, timeout=60, check=True)
    assert done.stdout.decode() == '{"one": "\u00e9"}\n'
    noise = [b"printed by Python", b"written to the handle", b"printed by C"]
    assert sorted(done.stderr.splitlines()) == sorted(noise)


def test_an_answer_leaves_before_the_process_ends():
    code = "from geokit.core.running.answers import take_stdout\ntake_stdout().write('answer\\n')\ninput()"
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    with subprocess.Popen([sys.executable, "-c", code], **pipes) as process:
        assert process.stdout.readline() == b"answer\n"
        process.kill()


def noisy(folder: Path, module: str) -> dict[str, str]:
    (folder / "sitecustomize.py").write_text(NOISE.format(module=module))
    return {"PYTHONPATH": str(folder)}


def test_compilers_of_kernels_answer_with_a_line(tmp_path, monkeypatch):
    for name, value in noisy(tmp_path, "geokit.core.launcher").items():
        monkeypatch.setenv(name, value)
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "text": True}
    with subprocess.Popen([sys.executable, "-c", _compile._BUILDER, "cpu"], **pipes) as process:
        assert _compile._build_one(process, "geokit.core.scan_kernels") == "ok"
        process.stdin.close()


@pytest.mark.parametrize(
    ("script", "module"),
    [(_latency._ASK, "geokit.core import launcher"), (doctor.GL_PROBE, "import pyvista")],
)
def test_other_processes_take_it_before_they_load_libraries(script, module):
    assert 0 <= script.index("answers = take_stdout()") < script.index(module)
    assert script.count("print(") == script.count("file=answers)") > 0
