"""What a release holds, and whether it works: python tests/release.py [--url URL] [--out dist] [--bare]

Builds the source archive and, from it, the wheel, of the files that git tracks. Refuses archives with too much or too
little in them, and a long description that an index would not render, where twine is installed. --bare: installs the wheel
into a virtual environment of its own, without extras, and runs the demo and the self-test there.

--url: where the repository is, as https://HOST/OWNER/NAME. It becomes the project's url, and the pictures and pages that
README.md names are those of the tag there, so that they show on a package index. Without it links stay as they are.
"""

import argparse
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from pathlib import Path

import diffsim_ti as ds

ROOT = Path(__file__).parents[1]
LEFT = re.compile(
    r"__pycache__|\..*cache|\.venv|\.ci-venv|.*\.egg-info|build|dist|output|imgui\.ini|.*\.pyc|PKG-INFO|setup\.cfg"
)
NOT_RELEASED = {".gitignore"}  # and .ci: they serve the repository


def tracked() -> list[str]:
    """Files of the repository, as paths from its root; of a tree without git, those that no tool has left there."""
    if (ROOT / ".git").exists():
        listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
        return [name for name in listed.split("\n") if name and (ROOT / name).is_file()]
    found = [path.relative_to(ROOT) for path in ROOT.rglob("*") if path.is_file()]
    return [str(path) for path in found if not any(LEFT.fullmatch(part) for part in path.parts)]


def released(files: list[str]) -> set[str]:
    """Those that the source archive holds."""
    return {name for name in files if not name.startswith((".ci/", ".github/")) and name not in NOT_RELEASED}


def with_links(readme: str, url: str, version: str) -> str:
    """README.md with links and pictures of the repository that work from anywhere."""

    def absolute(found: re.Match) -> str:
        kind = "raw" if found[1] == "!" else "blob"
        return f"{found[1]}[{found[2]}]({url}/{kind}/v{version}/{found[3]})"

    return re.sub(r"(!?)\[([^\]]*)\]\((?!https?:|#)([^)]+)\)", absolute, readme)


def copy(files: list[str], to: Path, url: str | None) -> None:
    """The tree that is built, with the url where there is one."""
    for name in files:
        (to / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, to / name)
    if url:
        readme, project = to / "README.md", to / "pyproject.toml"
        readme.write_text(with_links(readme.read_text(), url.rstrip("/"), ds.__version__))
        pages = dict(Repository="", Changelog=f"/blob/v{ds.__version__}/CHANGELOG.md", Issues="/issues")
        urls = "".join(f'{name} = "{url.rstrip("/")}{page}"\n' for name, page in pages.items())
        project.write_text(
            project.read_text().replace("[project.scripts]", f"[project.urls]\n{urls}\n[project.scripts]")
        )


def build(tree: Path, out: Path) -> tuple[Path, Path]:
    """(source archive, wheel)"""
    subprocess.run(
        [sys.executable, "-m", "build", "--outdir", str(out), str(tree)], check=True, stdout=subprocess.DEVNULL
    )
    return next(out.glob("*.tar.gz")), next(out.glob("*.whl"))


def check_source(archive: Path, files: list[str]) -> None:
    """Holds what is released, what setuptools writes, and nothing else."""
    with tarfile.open(archive) as content:
        held = {name.partition("/")[2] for name in content.getnames() if content.getmember(name).isfile()}
    made = {name for name in held if name in ("PKG-INFO", "setup.cfg") or ".egg-info/" in name}
    expected = released(files)
    assert held - made == expected, (
        f"missing {sorted(expected - held)[:5]}, too many {sorted(held - made - expected)[:5]}"
    )


def check_wheel(wheel: Path, files: list[str]) -> None:
    """Holds the package, its licence and what says what it is."""
    with zipfile.ZipFile(wheel) as content:
        held = set(content.namelist())
    package = {name for name in files if name.startswith("diffsim_ti/")}
    found = {name for name in held if ".dist-info/" not in name}
    assert found == package, f"missing {sorted(package - found)[:5]}, too many {sorted(found - package)[:5]}"
    assert "diffsim_ti/py.typed" in held and any(name.endswith("licenses/LICENSE") for name in held)


def check_description(*archives: Path) -> None:
    """That an index renders it, as twine says."""
    if importlib.util.find_spec("twine"):
        subprocess.run([sys.executable, "-m", "twine", "check", "--strict", *map(str, archives)], check=True)
    else:
        print("twine is not installed: whether an index renders the description is not checked")


def run_bare(wheel: Path, folder: Path) -> None:
    """The demo and the self-test, by the wheel alone."""
    subprocess.run([sys.executable, "-m", "venv", str(folder / "bare")], check=True)
    programs = folder / "bare" / ("Scripts" if os.name == "nt" else "bin")
    subprocess.run([str(programs / "pip"), "install", "-q", str(wheel)], check=True)
    subprocess.run([str(programs / "diffsim-ti"), "demo"], check=True, cwd=folder)
    pictures = [path for path in folder.rglob("*.png") if "bare" not in path.relative_to(folder).parts]
    subprocess.run([str(programs / "diffsim-ti"), "selftest"], check=True, cwd=folder)
    assert pictures and all(path.stat().st_size > 10_000 for path in pictures), "the demo wrote no picture"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--url", help="of the repository, for the links of README.md")
    parser.add_argument("--out", type=Path, help="keep both archives there")
    parser.add_argument("--bare", action="store_true", help="run demo and self-test in an environment of the wheel")
    arguments = parser.parse_args()
    files = tracked()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        copy(files, folder / "tree", arguments.url)
        source, wheel = build(folder / "tree", folder / "dist")
        check_source(source, files)
        check_wheel(wheel, files)
        check_description(source, wheel)
        for archive in (source, wheel):
            print(f"{archive.name}: {archive.stat().st_size / 1e6:.1f} MB")
            if arguments.out:
                arguments.out.mkdir(parents=True, exist_ok=True)
                shutil.copy(archive, arguments.out)
        if arguments.bare:
            (folder / "run").mkdir()
            run_bare(wheel, folder / "run")
            print("the demo and the self-test ran by the wheel alone")


if __name__ == "__main__":
    main()
