"""The documentation as a site: it is built without a broken link, and its pages say what the programs and files say."""

import re
import runpy
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tests.support.browser import browser, chromium
from tests.support.paths import ROOT

DOCS = ROOT / "docs"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """As `make docs` builds it, but for the place."""
    folder = tmp_path_factory.mktemp("site")
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    done = subprocess.run(build, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder


def test_every_page_is_there_and_none_fetches_anything(site: Path) -> None:
    written = {page.relative_to(DOCS).with_suffix("") for page in DOCS.rglob("*.md")}
    assert written <= {page.relative_to(site).with_suffix("") for page in site.rglob("*.html")}
    assert {"index.html", "contributing.html", "changelog.html"} <= {page.name for page in site.glob("*.html")}
    for page in site.rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        assert re.findall(r"<(?:script|img)[^>]*src=\"(?:https?:)?//", text) == []
        assert re.findall(r"<link[^>]*rel=\"stylesheet\"[^>]*href=\"(?:https?:)?//", text) == []


@pytest.mark.skipif(chromium() is None, reason="no Chromium to look with; apt-get install chromium")
def test_the_search_finds_from_disk_and_fetches_nothing(site: Path, tmp_path: Path) -> None:
    """Browsers start no worker for a page from disk, and the theme would fetch what stands in for one."""
    with browser(tmp_path) as page:
        for start in ("index.html", "estimate/index.html"):
            page.call("Page.navigate", url=f"{(site / start).as_uri()}?q=slip")
            page.wait_for("document.querySelectorAll('.md-search-result__item').length > 0")
        assert [each for each in page.requests if not each.startswith(("file:", "data:", "blob:"))] == []


def test_links_between_the_readme_and_the_pages_are_right_in_both(site: Path) -> None:
    start = (site / "index.html").read_text(encoding="utf-8")
    assert 'href="robot_setup.html"' in start
    assert 'src="merged_map.png"' in start
    for page in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *DOCS.rglob("*.md")):
        for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text(encoding="utf-8")):
            assert "://" in target or (page.parent / target).exists(), f"{page.name}: {target}"


def test_modules_that_the_mathematics_names_are_there() -> None:
    """They are named from `offline` on, or from the top."""
    for page in (DOCS / "estimate").glob("*.md"):
        names = re.findall(r"`(?:groundsbot\.)?([a-z_]+(?:\.[a-z_]+)+)`", page.read_text(encoding="utf-8"))
        for name in names:
            path = Path(*name.split("."))
            places = (ROOT / "offline" / path, ROOT / path)
            is_module = any(each.is_dir() or each.with_suffix(".py").is_file() for each in places)
            assert is_module or path.name in ("yaml", "json", "npz"), f"{page.name}: {name}"


def test_the_page_of_commands_is_what_the_programs_say() -> None:
    made = runpy.run_path(str(DOCS / "site" / "commands.py"))["page"]()
    assert (DOCS / "commands.md").read_text(encoding="utf-8") == made, "make docs writes it anew"


def test_every_dependency_has_its_reason() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    wanted = [
        *project["project"]["dependencies"],
        *(each for extra in project["project"]["optional-dependencies"].values() for each in extra),
        *project["dependency-groups"]["dev"],
    ]
    names = {re.split(r"[<>=;\s]", each)[0] for each in wanted}
    rows = [line.split("|")[1] for line in (DOCS / "dependencies.md").read_text("utf-8").splitlines() if "|" in line]
    told = {name.strip() for row in rows for name in row.split(",")} - {"package", "---", ""}
    assert told == names
