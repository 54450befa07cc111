"""A release is refused while something is open, and what it signs is what it made."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]
VERSION = "2.5.0"
USER = ("-c", "user.name=A Name", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=false")


@pytest.fixture(scope="module")
def release() -> ModuleType:
    spec = importlib.util.spec_from_file_location("release_script", ROOT / "packaging/release.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def git(folder: Path, *words: str) -> None:
    subprocess.run(["git", *USER, *words], cwd=folder, check=True, capture_output=True)


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A checkout that could be released."""
    folder = tmp_path / "tree"
    folder.mkdir()
    (folder / "pyproject.toml").write_text(f'[project]\nname = "a"\nversion = "{VERSION}"\n', encoding="utf-8")
    (folder / "CHANGELOG.md").write_text(f"# Changelog\n\n## [{VERSION}] - 2026-05-04\n\nText.\n", encoding="utf-8")
    git(folder, "init", "--quiet")
    git(folder, "add", ".")
    git(folder, "commit", "--quiet", "-m", "All of it")
    return folder


def test_a_whole_tree_has_no_obstacles(release: ModuleType, tree: Path) -> None:
    assert release.version_of(tree) == VERSION
    assert release.obstacles(tree, VERSION) == []
    git(tree, "tag", f"v{VERSION}")
    assert release.obstacles(tree, VERSION) == []


def test_obstacles_are_named(release: ModuleType, tree: Path) -> None:
    git(tree, "tag", f"v{VERSION}")
    (tree / "CHANGELOG.md").write_text(f"## [{VERSION}] - unreleased\n", encoding="utf-8")
    git(tree, "commit", "--quiet", "--all", "-m", "More")
    (tree / "loose.txt").write_text("text", encoding="utf-8")
    files, heading, tag = release.obstacles(tree, VERSION)
    assert files == "1 files are not committed, as loose.txt"
    assert (
        heading == f"CHANGELOG.md begins with '## [{VERSION}] - unreleased', not with '## [{VERSION}] - YEAR-MONTH-DAY'"
    )
    assert tag.startswith(f"the tag v{VERSION} is ")
    assert tag.endswith("raise the version")


def test_a_later_section_of_the_changelog_does_not_count(release: ModuleType, tree: Path) -> None:
    text = f"## [2.6.0] - 2026-06-01\n\n## [{VERSION}] - 2026-05-04\n"
    (tree / "CHANGELOG.md").write_text(text, encoding="utf-8")
    git(tree, "commit", "--quiet", "--all", "-m", "More")
    (found,) = release.obstacles(tree, VERSION)
    assert "begins with '## [2.6.0]" in found


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("gpg") is None, reason="GnuPG is not installed")
def test_sums_are_signed_and_what_changes_shows(
    release: ModuleType, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The path of the agent's socket has a limit of about a hundred characters.
    home = tmp_path_factory.mktemp("g")
    home.chmod(0o700)
    monkeypatch.setenv("GNUPGHOME", str(home))
    name = "Release <release@example.org>"
    try:
        release.run("gpg", "--batch", "--passphrase", "", "--quick-generate-key", name, "ed25519", "sign", "never")
        for file in ("a-1.whl", "a-1.tar.gz", "REHEARSAL"):
            (tmp_path / file).write_bytes(file.encode())
        sums = release.write_sums(tmp_path).read_text(encoding="utf-8").splitlines()
        assert [line.split("  ")[1] for line in sums] == ["a-1.tar.gz", "a-1.whl"]
        assert release.signing_key("release@example.org") == "release@example.org"
        release.sign(tmp_path, "release@example.org")
        with pytest.raises(release.ReleaseError, match=r"gpg --batch --list-secret-keys nobody@example.org"):
            release.signing_key("nobody@example.org")
        (tmp_path / "a-1.whl").write_bytes(b"other")
        with pytest.raises(release.ReleaseError, match=r"a-1.whl: FAILED"):
            release.sign(tmp_path, "release@example.org")
    finally:
        subprocess.run(["gpgconf", "--kill", "all"], check=False)
