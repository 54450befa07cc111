"""Runs every chart of every subject on every device; default subjects are the samples, or small generated shapes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from geokit.accuracy.trials.machine import machine_facts, version_facts
from geokit.accuracy.trials.measuring import measure
from geokit.accuracy.trials.model import Subject
from geokit.accuracy.trials.results import Failure, Results, info_of
from geokit.accuracy.trials.running import time_left
from geokit.core import launcher
from geokit.core.memory.needs import needs
from geokit.core.require import require_callable, require_flag, require_items
from geokit.errors import GeokitError, InputError
from geokit.mesh.surfaces.objects import require_mesh
from geokit.volume.tree.leaves import require_volume

if TYPE_CHECKING:
    from geokit.accuracy.trials.model import Chart, Measurement, Trial

ChartMaker = Callable[["Subject", Any, bool], "list[Chart]"]

SAMPLES = Path(__file__).resolve().parents[2] / "data" / "samples"
# Sharp, smooth and open meshes, closed ones first. A quick run takes the first of each kind.
MESHES = ("bracket.obj", "torus.ply", "shell.stl")
CLOUDS = ("cloud.ply",)
# File and grid.
VOLUMES = (("torus.vdb", "torus"), ("smoke.vdb", "density"))
# Corners around and across the generated torus, its radii, and the number of voxels of its level set.
SEGMENTS = (96, 48)
RADII = (1.0, 0.4)
VOXEL_SIZE = 0.04
HALF_WIDTH = 3.0
CLOUD_COUNT = 20_000


@needs(lambda *_, **__: 18 << 20, fatal=True)  # of modules too
def run(
    subjects: "Sequence[Subject] | None" = None,
    *,
    devices: Iterable[Any] | None = None,
    quick: bool = False,
    charts: Iterable[str] | None = None,
    progress: Callable[[str], None] | None = None,
) -> Results:
    """Measure the time and the error of geokit's methods over their settings.

    Errors are measured against an independent float64 reference. A method that raises does not end the run: it is
    listed in ``failures`` of the result, and its chart continues with the next method.

    Args:
        subjects: Meshes, volumes and clouds to measure on; None for the samples. Duplicate names get a number appended.
        devices: Where to compute ("cpu", "cuda:0"); None for every available device.
        quick: Fewer settings, smaller samples and shorter timing: under a minute for the samples on two cores.
        charts: Names of the charts to make; None for all.
        progress: Called with a line of text before each trial; after two seconds it says how much time is left.
    Returns:
        Results: a list of Measurement in order of measurement, with ``charts``, ``subjects`` and ``failures``.
    Raises:
        InputError: There is no subject, a subject does not hold exactly one thing, or a device or chart does not exist;
            the message lists the available ones.
    Example:
        >>> import numpy as np
        >>> cloud = gk.accuracy.Subject("cloud", points=np.random.default_rng(0).random((100, 3)))
        >>> rows = gk.accuracy.run([cloud], devices=["cpu"], quick=True, charts=["neighbors"])
        >>> {row.wrong_share for row in rows if "float64" in row.method}
        {0.0}
    """
    require_flag(quick, "quick")
    if progress is not None:
        require_callable(progress, "progress")
    if charts is not None:
        charts = [charts] if isinstance(charts, str) else require_items(charts, "charts", str)
    if devices is None:
        places = [launcher.resolve_device(alias) for alias in ("cpu", *launcher.cuda_devices())]
    else:
        items: list[Any] = require_items(devices, "devices")
        named = [launcher.resolve_device(device) for device in items]
        places = list({place.alias: place for place in named}.values())
    if not places:
        raise InputError("devices: empty; name at least one, or leave it out for all")
    found = _unique_names(
        list(default_subjects(quick=quick) if subjects is None else require_items(subjects, "subjects", Subject))
    )
    _check(found)
    subjects_by_name = {subject.name: subject for subject in found}
    results = Results(subjects=subjects_by_name, machine=machine_facts(), versions=version_facts())
    tell = progress or (lambda line: None)
    planned = list(_planned(found, places, quick, results))
    wanted = _wanted(charts, planned)
    chosen = [plan for plan in planned if plan[2].name in wanted]
    started = time.perf_counter()
    for done, (subject, place, chart) in enumerate(chosen):
        results.charts.setdefault(chart.name, info_of(chart))
        told = _ending(tell, time_left(started, done, len(chosen), "charts"))
        for row in _measured(chart, subject, place, quick, results.failures, told):
            results.append(row)
    return results


def _ending(tell: Callable[[str], None], end: str) -> Callable[[str], None]:
    return lambda line: tell(line + end)


def _check(subjects: "list[Subject]") -> None:
    if not subjects:
        raise InputError("subjects: empty; give at least one, or leave it out for the samples")
    for row, subject in enumerate(subjects):
        if subject.mesh is not None:
            subjects[row] = subject._replace(mesh=require_mesh(subject.mesh, f"subjects[{row}].mesh", images=False))
        if subject.volume is not None:
            require_volume(subject.volume, f"subjects[{row}].volume")
        held = sum(part is not None for part in (subject.mesh, subject.volume, subject.points))
        if held != 1:
            raise InputError(f"subjects: {row} ({subject.name!r}) holds {held} things; give a mesh, a volume or points")


def _planned(
    subjects: "list[Subject]", places: list[Any], quick: bool, results: Results
) -> "Iterator[tuple[Subject, Any, Chart]]":
    for subject in subjects:
        for place in places:
            for maker in _makers(subject):
                try:
                    made = maker(subject, place.alias, quick)
                except Exception as error:  # a chart that cannot be made must not stop the others
                    results.failures.append(Failure("", subject.name, place.alias, "", "", _message(error)))
                    continue
                for chart in made:
                    yield subject, place, chart


def _makers(subject: "Subject") -> list[ChartMaker]:
    """The functions that make the charts of a subject of this kind."""
    from geokit.accuracy.charts import makers

    if subject.mesh is not None:
        return [makers.mesh_charts, makers.mesh_volume_charts]
    return [makers.points_charts if subject.volume is None else makers.volume_charts]


def _wanted(charts: Iterable[str] | None, planned: "list[tuple[Subject, Any, Chart]]") -> set[str]:
    known = dict.fromkeys(chart.name for _, _, chart in planned)
    if charts is None:
        return set(known)
    for name in charts:
        if name not in known:
            raise InputError(f"charts: there is no {name!r} for these subjects; use one of {', '.join(known)}")
    return set(charts)


def _measured(
    chart: "Chart", subject: "Subject", place: Any, quick: bool, failures: list[Failure], tell: Callable[[str], None]
) -> "Iterator[Measurement]":
    def failed(error: Exception, trial: "Trial | None") -> None:
        method, setting = (trial.method, trial.setting) if trial else ("", "")
        failures.append(Failure(chart.name, subject.name, place.alias, method, setting, _message(error)))
        tell(f"{chart.name}, {subject.name}, {place.alias}: {method} {setting} failed: {_message(error)}")

    try:
        trials = iter(chart.trials())
    except Exception as error:
        failed(error, None)
        return
    while True:
        trial = None
        try:
            trial = next(trials, None)
            if trial is None:
                return
            tell(f"{chart.name}, {subject.name}, {place.alias}: {trial.method}, {trial.setting}")
            row = measure(trial, chart, subject.name, place, quick=quick)
        except Exception as error:
            failed(error, trial)
            if trial is None:  # a generator that has raised yields nothing more
                return
            continue
        yield row


def _message(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"


@needs(lambda *_, **__: 8 << 20, fatal=True)  # of modules too: the compiler names a syntax error where it has none
def default_subjects(*, quick: bool = False) -> list[Subject]:
    """The samples of the source tree, or generated shapes if the samples are missing, as in an installed wheel.

    Samples that need a part of geokit that is not installed are replaced in the same way.

    Args:
        quick: Return one mesh, one volume and one cloud.
    Returns:
        Subjects of each kind.
    """
    require_flag(quick, "quick")
    meshes = _loaded_meshes() or [_torus_mesh()]
    volumes = _loaded_volumes() or [_torus_volume()]
    clouds = _loaded_clouds() or [_torus_cloud()]
    return [*meshes[:1], *volumes[:1], *clouds[:1]] if quick else [*meshes, *volumes, *clouds]


def _unique_names(subjects: list[Subject]) -> list[Subject]:
    """The subjects, with a number appended to every name that occurred before."""
    taken: set[str] = set()
    found: list[Subject] = []
    for subject in subjects:
        name, number = subject.name, 1
        while name in taken:
            number += 1
            name = f"{subject.name} ({number})"
        taken.add(name)
        found.append(subject._replace(name=name))
    return found


def _loaded_meshes() -> list[Subject]:
    from geokit.mesh import load

    return [Subject(name, mesh=load(SAMPLES / name)) for name in MESHES if (SAMPLES / name).is_file()]


def _loaded_clouds() -> list[Subject]:
    from geokit.points import load

    return [Subject(name, points=load(SAMPLES / name).points) for name in CLOUDS if (SAMPLES / name).is_file()]


def _loaded_volumes() -> list[Subject]:
    from geokit.volume import load

    found: list[Subject] = []
    for name, grid in VOLUMES:
        if not (SAMPLES / name).is_file():
            continue
        try:
            found.append(Subject(name, volume=load(SAMPLES / name, grid=grid)))
        except GeokitError:  # without the OpenVDB extension
            return []
    return found


def _torus_mesh() -> Subject:
    from geokit.accuracy.stability.shapes import torus

    return Subject("torus", mesh=torus(*SEGMENTS, *RADII))


def _torus_volume() -> Subject:
    from geokit.volume import from_mesh

    mesh = _torus_mesh().mesh
    assert mesh is not None
    return Subject("torus volume", volume=from_mesh(mesh, VOXEL_SIZE, half_width=HALF_WIDTH, device="cpu"))


def _torus_cloud() -> Subject:
    from geokit.accuracy.charts.points import torus_cloud

    return Subject("torus cloud", points=torus_cloud(CLOUD_COUNT, noise=0.0)[0])
