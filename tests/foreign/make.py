"""Makes files in the environment of the other programs: `python -m tests.foreign.make FOLDER ID ...`.

Prints what failed, by the file's id, as one line of JSON.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

from tests.foreign.table import ROWS


def main() -> None:
    # What libraries print goes elsewhere.
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    failed = {}
    for row in ROWS:
        if row.id in sys.argv[2:]:
            folder = Path(sys.argv[1]) / row.id
            folder.mkdir(parents=True)
            try:
                row.make(folder / f"a{row.kind}")
            except Exception as error:
                failed[row.id] = f"{type(error).__name__}: {error}"
    print(json.dumps(failed), file=answers, flush=True)


if __name__ == "__main__":
    main()
