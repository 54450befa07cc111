"""Warp is imported where it is first used, and from then on every module has warp itself."""

import subprocess
import sys


def test_warp_comes_with_its_first_use_and_takes_its_place_everywhere():
    code = (
        "import sys, geokit as gk\n"
        "from geokit.core import launcher, scan\n"
        "late = scan.wp\n"
        "assert 'warp' not in sys.modules and launcher.wp is late\n"
        "assert late.float32.__name__ == 'float32'\n"
        "import warp\n"
        "from geokit.core.memory import pinned\n"
        "assert launcher.wp is scan.wp is pinned.wp is warp\n"
        "assert late.float64 is warp.float64\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
