"""Command lines that ``--help`` shows below a command's options; docs/cli.md has the same ones."""

from __future__ import annotations

from collections.abc import Sequence

from geokit.cli._program.app import GROUPS, VERBS

__all__ = ["EXAMPLES", "examples_of"]

# What to try first, for the help of the program.
FIRST = """\
geokit info bunny.usd
geokit view bunny.usd -o bunny.html
geokit convert bunny.usd bunny.vdb --voxel-size 0.01 --half-width 3
geokit guide
"""

EXAMPLES = """\
geokit info bunny.usd
geokit info smoke.vdb --json
geokit info scan.ply --stream --memory-limit 4000000000
geokit guide
geokit guide hollow > hollow.py
geokit convert bunny.usd bunny.ply
geokit convert bunny.usd bunny.vdb --voxel-size 0.01 --half-width 3
geokit convert bunny.usd shell.vdb --voxel-size 0.01 --thickness 0.05
geokit convert scan.ply scan.nvdb --voxel-size 0.01 --stream --memory-limit 4000000000
geokit convert survey.ply thin.ply --stream --voxel-size 0.01 --normals 16
geokit convert bunny.vdb bunny.nvdb --codec blosc
geokit convert bunny.vdb bunny-fp8.nvdb --codec fp8,zip
geokit convert bunny.vdb small.nvdb --tolerance 1e-4
geokit convert smoke.vdb density.nvdb --grid density
geokit convert bunny.vdb shell.obj --isovalue 0.02 --adaptivity 0.5
geokit convert segmentation.nii.gz liver.stl --label 2
geokit convert bunny.usd field.nvdb --tolerance 1e-3
geokit convert bunny.vdb bunny.obj --tolerance 1e-3
geokit convert bunny.usd light.obj --tolerance 1e-3
geokit convert bunny.usd points.xyz --count 20000
geokit convert bunny.usd metric.vtp --from-unit cm --unit mm --from-up y --up z
geokit convert cloud.ply balls.vdb --radius 0.02
geokit convert cloud.ply skin.stl
geokit convert smoke.vdb smoke.npz --grid density
geokit convert scans/*.ply --out-dir volumes --to nvdb --voxel-size 0.01 --jobs 4
geokit convert smoke.vdb density.mha --grid density
geokit convert density.mha dense.nvdb --background 0 --background-tolerance 0.01
geokit convert cloud.ply spray.vdb --kind cloud
geokit convert smoke.vdb smoke.usda --kind volume
geokit batch fields.toml scans/*.ply --out fields
geokit batch fields.toml scans/*.ply --out fields --jobs 2 --retry-failed
geokit mesh sphere ball.ply --radius 2 --segments 96
geokit mesh box box.ply --size 2 1 1
geokit mesh cylinder pin.ply --radius 0.5 --height 3
geokit mesh cone tip.ply --radius 1 --height 2 --center 0 0 1
geokit mesh torus ring.ply --radius 1 --tube-radius 0.25
geokit mesh plane ground.ply --size 10 10 --segments 20
geokit mesh split bunny.usd pieces.ply
geokit mesh keep-largest hollow.stl clean.stl
geokit mesh transform ball.ply moved.ply --scale 0.001 --rotate 1 0 0 90 --move 0 0 5
geokit mesh transfer ball.ply bunny.usd painted.vtp --name color
geokit repair scan.ply repaired.ply
geokit repair scan.ply closed.3mf --tolerance 0.01mm --max-width 5mm --from-unit mm
geokit repair scan.ply untangled.ply --untangle 8
geokit wrap scan.ply solid.3mf --tolerance 5mm --gap 20mm --from-unit m
geokit wrap cloud.ply skin.ply --tolerance 0.02 --cavities
geokit boolean union a.stl b.stl c.stl union.stl
geokit boolean difference body.stl tool.stl cut.stl
geokit boolean intersection a.stl b.stl common.stl
geokit hollow part.3mf hollow.3mf --wall 2mm
geokit hollow ring.stl drained.stl --wall 3 --voxel-size 1 --drain 20,0,-8 --drain -20,0,-8 --drain-radius 1.5
geokit compare scan.ply design.stl
geokit compare scan.ply design.stl report.html --align --limit 0.1mm --from-unit mm
geokit compare scan.ply design.stl deviation.csv
geokit query closest   bunny.usd points.csv -o closest.vtp
geokit query signed    bunny.usd points.npy -o distances.npz
geokit query ray       bunny.usd rays.csv   -o hits.csv
geokit query sample    smoke.vdb points.csv --grid density --gradient -o samples.csv
geokit query neighbors cloud.ply --radius 0.02 -o neighbors.npz
geokit query neighbors cloud.ply points.npy --nearest 8 -o nearest.csv
geokit query signed    bunny.usd points.csv -o - | head
geokit query signed    bunny.usd points.csv --sign winding -o signed.csv
geokit plan bunny.usd --tolerance 1e-3
geokit plan bunny.usd --tolerance 1e-3 --order 1 --codec float --json
geokit bench bunny.usd --out report/
geokit bench --quick --out quick/
geokit bench --stability --out docs --force
geokit volume union a.vdb b.vdb c.vdb union.vdb --smooth 0.1
geokit volume intersection a.vdb b.vdb common.vdb
geokit volume difference body.vdb tool.vdb cut.nvdb
geokit volume offset in.vdb thinner.nvdb --distance -0.05
geokit volume dilate smoke.vdb thicker.vdb --grid density --voxels 2
geokit volume erode in.vdb eroded.vdb --distance 0.05
geokit volume opening in.vdb opened.vdb --distance 0.05
geokit volume closing in.vdb closed.vdb --distance 0.05
geokit volume renormalize in.vdb wide.vdb --half-width 5
geokit volume smooth in.vdb smooth.vdb --method mean_curvature --iterations 4
geokit volume resample in.vdb coarse.vdb --voxel-size 0.02
geokit volume resample in.vdb aligned.vdb --like other.nvdb
geokit volume resample smoke.vdb half.vdb --voxel-size 0.1 --grid all
geokit volume prune smoke.vdb pruned.vdb --grid density --tolerance 0.01
geokit volume clip smoke.vdb part.vdb --grid density --lower -1 -1 -1 --upper 1 1 0
geokit volume gradient in.vdb gradient.vdb
geokit volume divergence smoke.vdb divergence.vdb --grid velocity
geokit volume curl smoke.vdb vorticity.vdb --grid velocity
geokit volume laplacian in.vdb laplacian.vdb
geokit volume connected-components smoke.vdb labels.vdb --grid density
geokit volume segment smoke.vdb parts.vdb --grid density
geokit volume statistics in.vdb --json
geokit render bunny.usd -o bunny.png --size 1200x900 --color y
geokit render bunny.vdb -o slice.png --slice z          # or slice.svg, slice.pdf
geokit render smoke.vdb -o smoke.png --grid density
geokit render smoke.vdb -o white.png --look smoke      # white, lit, in front of the dark
geokit render closest.vtp -o distances.png --color distance
geokit render bunny.obj -o back.png --azimuth 180 --elevation 30 --zoom 1.5 --edges
geokit render bunny.usd -o ground.png --shadow
geokit view bunny.usd -o bunny.html
geokit view bunny.vdb smoke.vdb cloud.ply
geokit view smoke.vdb -o smoke.html --grid density --colormap gray --title "Smoke, frame 40"
geokit doctor
geokit doctor --compile
geokit doctor --latency --device cpu
geokit demo --out demo/
geokit demo --out part/ --mesh part.stl
"""


def examples_of(arguments: Sequence[str]) -> list[str]:
    """Examples for a command line that prints help: those of its command, or of the group; [] if it asks for none."""
    asks = bool({"--help", "-h"}.intersection(arguments)) or arguments[:1] == ["help"]
    if not asks and arguments and not (len(arguments) == 1 and arguments[0] in GROUPS):
        return []
    words = [word for word in arguments if not word.startswith("-")]
    first = next((at for at, word in enumerate(words) if word in VERBS), len(words))
    words = words[first : first + 2]
    if not words:
        return FIRST.splitlines()
    lines = EXAMPLES.splitlines()
    return [line for line in lines if line.split()[1:3] == words] or [
        line for line in lines if line.split()[1] == words[0]
    ]
