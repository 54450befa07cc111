#!/usr/bin/env bash
# On a machine with a GPU: are kernels that were compiled ahead loaded, how long do first calls take, are answers the
# same? Usage: PYTHON=.venv/bin/python packaging/check_cuda_kernels.sh FOLDER [ARCH]     (ARCH of an H100 or H200: 90)
#
# Expected: "N objects, 10 MB" with N above 200 (each object has three names); in ahead.json every row has "compiled": 0
# and "first [s]" below 2; in compiled.json "compiled" is 2 to 10 in most rows; "same answers" at the end. Rows that
# differ in answers.py mean that warp's way at home (PTX, compiled by the driver) rounds otherwise than machine code of
# NVRTC: then ship PTX (ARCH-ptx) instead, or name the rows in docs/design/cold-start.md.
set -euo pipefail
out=$1 arch=${2:-90} python=${PYTHON:-python}
cd "$(dirname "$0")/.."
mkdir -p "$out"
WARP_CACHE_PATH=$out/cache $python packaging/kernels.py "$out/objects" --cuda "$arch" --cpu x86-64-v3 x86-64-v4 |
  tail -n 1
export WARP_CACHE_PATH=$out/jit
GEOKIT_KERNELS=$out/objects $python -m geokit doctor --latency --device cuda:0 --json >"$out/ahead.json"
GEOKIT_KERNELS='' $python -m geokit doctor --latency --device cuda:0 --json >"$out/compiled.json"
$python - "$out" <<'END'
import json, sys
ahead, jit = (json.load(open(f"{sys.argv[1]}/{name}.json")) for name in ("ahead", "compiled"))
for a, b in zip(ahead, jit):
    print(f"{a['call']:36} {a['first [s]']:7.2f} s (compiled {a['compiled']}), without objects {b['first [s]']:7.2f} s")
slow = [a["call"] for a in ahead if a["compiled"] or a["first [s]"] > 2.0]
print("slower than 2 s, or compiled:", slow or "none")
END
GEOKIT_KERNELS=$out/objects $python benchmarks/answers.py --device cuda:0 --out "$out/ahead.txt" >"$out/ahead.log"
GEOKIT_KERNELS='' $python benchmarks/answers.py --device cuda:0 --compare "$out/ahead.txt" && echo "same answers"
