"""Make a release in dist/VERSION: ``./dev release [--key KEY] [--bare SUITE ...] [--rehearse]``.

Builds, tries and signs; publishing is left to a person, who is told the commands. The steps, each of which stops what
follows it:

1. The tree is clean, CHANGELOG.md gives the version of pyproject.toml a date, and the tag vVERSION, if there is one,
   is the commit that is checked out. ``--rehearse`` does without these, and marks what it made as a rehearsal.
2. The source distribution, and all wheels from what it holds, so that nothing that a wheel needs lies beside it.
3. Each wheel is installed and used (wheel.py does that), and with ``--bare bookworm`` in a bare Debian system
   (test_wheel.sh). Metadata and README are read as the index reads them (twine check).
4. ``SHA256SUMS`` of all files, signed with the key of GnuPG that ``--key`` names, by default git's ``user.signingkey``.
   Sums and signature are read again.

Needs build and twine beside what wheel.py needs.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SUMS, SIGNATURE, REHEARSAL = "SHA256SUMS", "SHA256SUMS.asc", "REHEARSAL"
# The files of a release that an index takes.
PACKAGES = (".whl", ".tar.gz")


class ReleaseError(Exception):
    """What keeps a release from being made."""


def say(message: str) -> None:
    print(f"release: {message}", flush=True)


def run(*command: object, cwd: Path = ROOT, env: dict[str, str] | None = None) -> str:
    """Run a command and return its output.

    Raises:
        ReleaseError: It failed; the message has its output.
    """
    words = [str(word) for word in command]
    done = subprocess.run(words, cwd=cwd, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    if done.returncode != 0:
        raise ReleaseError(f"failed: {' '.join(words)}\n{done.stdout.strip()}")
    return done.stdout


def version_of(root: Path) -> str:
    """The version of pyproject.toml."""
    match = re.search(r'^version = "([^"]+)"', (root / "pyproject.toml").read_text(encoding="utf-8"), re.MULTILINE)
    if match is None:
        raise ReleaseError("pyproject.toml: no line 'version = \"...\"'")
    return match[1]


def obstacles(root: Path, version: str) -> list[str]:
    """What keeps the tree from being released under a version, one sentence each."""
    found = []
    if changed := run("git", "status", "--porcelain", cwd=root).splitlines():
        found.append(f"{len(changed)} files are not committed, as {changed[0][3:]}")
    heading = re.search(r"^## .*$", (root / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    if heading is None or not re.fullmatch(rf"## \[{re.escape(version)}\] - \d{{4}}-\d\d-\d\d", heading[0]):
        shown = "nothing" if heading is None else f"'{heading[0]}'"
        found.append(f"CHANGELOG.md begins with {shown}, not with '## [{version}] - YEAR-MONTH-DAY'")
    tag = f"v{version}"
    if run("git", "tag", "--list", tag, cwd=root).strip():
        tagged, here = (run("git", "rev-list", "-1", name, cwd=root).strip() for name in (tag, "HEAD"))
        if tagged != here:
            found.append(f"the tag {tag} is {tagged[:9]}, and {here[:9]} is checked out: raise the version")
    return found


def build(folder: Path) -> None:
    """The source distribution, and wheels from its content."""
    say("building the source distribution")
    run(sys.executable, "-m", "build", "--sdist", "--outdir", folder, ROOT)
    (source,) = folder.glob("*.tar.gz")
    with tempfile.TemporaryDirectory() as room:
        with tarfile.open(source) as archive:
            archive.extractall(room, filter="data")
        (tree,) = Path(room).iterdir()
        # Kernels that earlier builds compiled are known by their content.
        (ROOT / "build/kernels").mkdir(parents=True, exist_ok=True)
        (tree / "build").mkdir()
        (tree / "build/kernels").symlink_to(ROOT / "build/kernels")
        for native in ("ON", "OFF"):
            say("building the wheels" if native == "ON" else "building the plain wheel")
            run(sys.executable, tree / "packaging/wheel.py", cwd=tree, env={**os.environ, "GEOKIT_NATIVE": native})
        for made in (tree / "dist").glob("*.whl"):
            shutil.copy(made, folder)


def packages(folder: Path) -> list[Path]:
    """The source distribution and the wheels of a folder."""
    return sorted(path for path in folder.iterdir() if path.name.endswith(PACKAGES))


def try_bare(folder: Path, suites: Iterable[str]) -> None:
    """Try the wheel for the Python of each Debian system in a bare one."""
    minors = {"bookworm": "cp311-cp311", "trixie": "cp312-abi3"}
    for suite in suites:
        (made,) = folder.glob(f"*-{minors[suite]}-*.whl")
        say(f"trying {made.name} in a bare {suite}")
        run("bash", ROOT / "packaging/test_wheel.sh", ROOT / "build/bare", made, suite)


def write_sums(folder: Path) -> Path:
    """Write the SHA-256 of each file of a release, in the form that ``sha256sum --check`` reads."""
    lines = [f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}\n" for path in packages(folder)]
    (folder / SUMS).write_text("".join(lines), encoding="utf-8")
    return folder / SUMS


def sign(folder: Path, key: str) -> None:
    """Sign the sums, and read sums and signature again.

    Raises:
        ReleaseError: GnuPG does not have the secret key, or something does not agree.
    """
    run("gpg", "--batch", "--yes", "--armor", "--local-user", key, "--detach-sign", SUMS, cwd=folder)
    run("gpg", "--batch", "--verify", SIGNATURE, SUMS, cwd=folder)
    run("sha256sum", "--check", "--strict", SUMS, cwd=folder)


def signing_key(given: str | None) -> str:
    """The key to sign with: the one given, else git's."""
    done = subprocess.run(["git", "config", "user.signingkey"], cwd=ROOT, capture_output=True, text=True)
    key = given or done.stdout.strip()
    if not key:
        raise ReleaseError("no key to sign with: --key KEY, or git config user.signingkey KEY")
    run("gpg", "--batch", "--list-secret-keys", key)
    return key


def release(given: argparse.Namespace) -> None:
    version = version_of(ROOT)
    if (found := obstacles(ROOT, version)) and not given.rehearse:
        raise ReleaseError("; ".join(found))
    # Asked before minutes of building.
    key = None if given.rehearse and given.key is None else signing_key(given.key)
    folder = ROOT / "dist" / version
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    if given.rehearse:
        (folder / REHEARSAL).write_text("".join(f"{line}\n" for line in found), encoding="utf-8")
    build(folder)
    try_bare(folder, given.bare)
    say("reading metadata and README as the index does")
    run(sys.executable, "-m", "twine", "check", "--strict", *packages(folder))
    write_sums(folder)
    if key is not None:
        sign(folder, key)
    for path in sorted(folder.iterdir()):
        say(f"{path.relative_to(ROOT)}: {path.stat().st_size / 1e6:.1f} MB")
    if given.rehearse:
        say("a rehearsal, not to be published" + "".join(f"; {line}" for line in found))
        return
    say("made, tried and signed. To publish it:")
    print(f"  git tag -s v{version} && git push origin v{version}")
    print(f"  {sys.executable} -m twine upload {folder.relative_to(ROOT)}/*.tar.gz {folder.relative_to(ROOT)}/*.whl")
    print(f"  {SUMS} and {SIGNATURE} go beside the files of the release's page")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--key", help="the key of GnuPG to sign with, by default git's user.signingkey")
    parser.add_argument("--bare", nargs="*", default=[], choices=["bookworm", "trixie"], metavar="SUITE")
    parser.add_argument("--rehearse", action="store_true", help="do without a clean tree, a date and a key")
    try:
        release(parser.parse_args())
    except ReleaseError as error:
        print(f"release: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
