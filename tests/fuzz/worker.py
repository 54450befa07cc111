"""Runs mutants in this process: ``python -m tests.fuzz.worker FOLDER``, then lines "CONTENT KIND\\n" and "SEED\\n".

Prints a line of JSON once it is ready for a target and for each mutant. If a mutant ends the process, its line is
missing.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import resource
import shutil
import sys
import time
from pathlib import Path

from tests.fuzz.mutators import mutate
from tests.fuzz.originals import Target, originals
from tests.fuzz.trial import outcome, sound_facts, write

# What a mutant of a few kilobytes may take: twice what geokit lets the content of such a file take.
MEMORY_BYTES = 2 << 30


def main() -> None:
    folder = Path(sys.argv[1])
    answers = os.fdopen(os.dup(1), "w")
    # Nothing may be printed. What is goes to a file whose size tells.
    printed = os.open(folder / "printed", os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND)
    os.dup2(printed, 1)
    os.dup2(printed, 2)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    for text in sys.stdin:
        if " " in text:
            resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY,) * 2)
            for path in folder.iterdir():
                if path.name != "printed":
                    shutil.rmtree(path) if path.is_dir() else path.unlink()
            target = Target(*text.split())
            with contextlib.redirect_stderr(io.StringIO()):  # meshio warns of what it writes
                sources = originals(target)
            sound = sound_facts(target, sources, folder)
            mapped = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
            resource.setrlimit(resource.RLIMIT_AS, (mapped + MEMORY_BYTES, resource.RLIM_INFINITY))
            before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            print(json.dumps({"ready": len(sources)}), file=answers, flush=True)
            continue
        seed = int(text)
        mutant = mutate(target, sources, seed)
        path = write(folder, target.kind, mutant.data, mutant.beside)
        size, start, cpu = os.fstat(printed).st_size, time.monotonic(), time.process_time()
        end = outcome(target, path, sound[mutant.variant], seed)
        seconds, cpu = time.monotonic() - start, time.process_time() - cpu
        if os.fstat(printed).st_size > size:
            end = f"printed: {os.pread(printed, 200, size)!r}, then {end}"
        grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before >> 10
        told = {"seed": seed, "end": end, "seconds": round(seconds, 3), "cpu": round(cpu, 3), "grown": grown}
        told |= {"variant": mutant.variant, "mended": mutant.mended, "damage": mutant.damage}
        print(json.dumps(told), file=answers, flush=True)


if __name__ == "__main__":
    main()
