"""Color maps that pages and reports have without matplotlib, which knows many more."""

from __future__ import annotations

import base64
import functools
import zlib

import numpy as np
from numpy.typing import NDArray

from geokit._packages import require_package

SIZE = 256
# Matplotlib's maps of these names, as differences between one color and the next, modulo 256: zlib in base 85.
HELD = ("viridis", "RdBu_r", "coolwarm", "magma", "turbo", "gray")
PACKED = (
    "c-rlkNwyO)3`HfmXvVCBIa7uV*#J9bU&I#HQ)9c5tN`+T-nn{`D^(SD|2zLAmibporpzK!Db!;3ml^D^Wz$pxDsvBu4Hyui7mycdaHVKo*<m*imY"
    "3O^)@5H8tdL&Ryz9Gw-WBNc6~d%4mA2Gw@}4DkcC~E0(e&dr`1=l6>@PSt6(*n>y$r|BE!fOfV5U1Bj#*<m>rs;$HLJkbdky#s2bCzWj^SwZ4e)O"
    "#6i_o@z*Gh^SO8Py!`ELdZMD{9g|hn&vKOBzWarfxvj-rE90WJ<F6A@q?B33HEtci;bM{TcwVO@fg9C7#lPSss&c>LXT(f^MRTfVg*<{M4WviUSp"
    "LDPevbHnYc$;Em@BZjIObvRc;f?_m(0deA<*P1gm1qg0ALi&!1p$5QQdtGtg)>xi(MWZDU1MLQ>cw8;k<u%DY0mdT@49^Z@tY;bqK!I{jXD3Sz|%"
    "Q^E9E0LQaPU22xs0+I>tW+VPH*=+Kyr)^8JT%|H<(t+aQchiErDK+;%EkugcMtip8*YCtbzG2~6dyYi?h<t5ir^YPDgGg69~%>lRv#4fS$@bMV_v"
    "m7%9nVXkSS^kh<S0nFjLLQPZ0s>H<EQ|2qOnoiY37EaYfnCjQu%mAMV>Fnkc$E?Xo6rkgw`e)bSOmuN<pZG~_yTD5Ai(haq*#|U?&2p-~g-N+^63"
    "Qr-UJIMp2r}@jwQw+OHJ}b*ISCjC9L~*zN@KFnZ9(>X+SXpGHQAhk_58^`!dG}!=5^vIm%eUUO<&Ke=~>`i^ekB5-y&;P`uxok3(<ah!MdTxQAhG"
    "nbc1-Oil5hgqI}~HoBHGV+oT#40r4thbkN@T=1BRAmnmB)r<1^ExDS?9bA-A=sV>D|zkHMSncJtQ_R*R+eDIJah=m4I<zk0+fv<!HnA!*jB!HxfL"
    "MhaahLq>U)Opm?R1Ixo!jLhVs_6iC;{~QFeL8ARrwJTDrk&V;XUKB}?jlo%OlPtkWvA0k*%a+D^#VZqMFz$JkBcmXg1uS6gfZD+KG3Bd=T$reG@n"
    "(?u?HnUsol8g<WXw3Uof9QP-d{yo)1d9M(dh9mtuQE1T#4f6KG=(=c1Yih>^#Lf?&OI9C8A3xyD}M`w31-2{aB(z>d*RNL6RQ$1&E8?+@`XU=JUm"
    "_OBHG|NQ^_tDnC_;Jx4"
)


@functools.lru_cache(maxsize=16)
def color_table(name: str) -> NDArray[np.uint8]:
    """The colors of a map, (256, 3).

    Raises:
        MissingDependencyError: The map is one of matplotlib's others, and that is not installed.
    """
    if name not in HELD:
        at = np.linspace(0.0, 1.0, SIZE)
        return np.rint(255.0 * require_package("matplotlib").colormaps[name](at)[:, :3]).astype(np.uint8)
    steps = np.frombuffer(zlib.decompress(base64.b85decode(PACKED)), np.uint8).reshape(len(HELD), SIZE, 3)
    found: NDArray[np.uint8] = np.add.accumulate(steps[HELD.index(name)], axis=0, dtype=np.uint8)
    return found
