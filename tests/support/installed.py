"""The distribution as users install it: built as a wheel from this checkout or any revision, in a folder alone."""

import os
import subprocess
import sys
import tarfile
from io import BytesIO
from pathlib import Path

from tests.support.paths import ROOT


def checkout_sources(folder: Path) -> Path:
    """What git would ship of the checkout as it stands, copied, so that a build leaves nothing behind in it."""
    for name in output_of(["git", "ls-files", "--cached", "--others", "--exclude-standard"], ROOT).splitlines():
        source, target = ROOT / name, folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if source.is_symlink():
            target.symlink_to(source.readlink())
        elif source.is_file():
            target.write_bytes(source.read_bytes())
    return folder


def revision_sources(revision: str, folder: Path) -> Path:
    """What git has of a revision."""
    archive = subprocess.run(["git", "archive", revision], cwd=ROOT, stdout=subprocess.PIPE, check=True).stdout
    with tarfile.open(fileobj=BytesIO(archive)) as files:
        files.extractall(folder, filter="data")
    return folder


def install(sources: Path, target: Path) -> Path:
    """Builds a wheel of sources and installs it alone in the folder `target`; what it needs comes from this Python."""
    built = target.with_name(f"{target.name}-wheel")
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(built), str(sources)]
    output_of(build, sources.parent)
    (wheel,) = built.glob("groundsbot-*.whl")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--target", str(target)]
    output_of([*pip, str(wheel)], sources.parent)
    return target


def output_of(command: list[str], folder: Path, first_on_path: Path | None = None) -> str:
    """What a command that succeeds prints, run in a folder."""
    environment = dict(os.environ)
    if first_on_path is not None:
        environment["PYTHONPATH"] = str(first_on_path)
    found = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stdout + found.stderr
    return found.stdout
