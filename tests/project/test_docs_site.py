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
        for start, word in (("index.html", "slip"), ("estimate/index.html", "slip"), ("index.html", "glossary")):
            page.call("Page.navigate", url=f"{(site / start).as_uri()}?q={word}")
            page.wait_for("document.querySelectorAll('.md-search-result__item').length > 0")
        page.wait_for("document.querySelector('.md-search-result__link[href*=\"glossary.html\"]') !== null")
        assert [each for each in page.requests if not each.startswith(("file:", "data:", "blob:"))] == []


@pytest.mark.skipif(chromium() is None, reason="no Chromium to look with; apt-get install chromium")
def test_no_page_is_wider_than_a_phone(site: Path, tmp_path: Path) -> None:
    """Tables and listings scroll on their own; a page that is cut off, or scrolls as a whole, is too wide."""
    cut_off = """[...document.querySelectorAll('article *')].filter(each =>
        each.getBoundingClientRect().right > innerWidth + 1 && !each.closest('pre, .md-typeset__scrollwrap'))"""
    with browser(tmp_path) as page:
        page.call("Emulation.setDeviceMetricsOverride", width=390, height=844, deviceScaleFactor=1, mobile=True)
        for path in sorted(site.rglob("*.html")):
            page.call("Page.navigate", url=path.as_uri())
            page.wait_for(f"location.href === '{path.as_uri()}' && document.readyState === 'complete'")
            width = page.look("[document.documentElement.scrollWidth, innerWidth]")
            assert width == [390, 390], f"{path.name}: {width}"
            assert page.look(f"{cut_off}.map(each => each.outerHTML.slice(0, 80))") == [], path.name


def test_the_glossary_is_in_order_and_says_each_term_in_a_sentence_or_two() -> None:
    lines = (DOCS / "glossary.md").read_text(encoding="utf-8").splitlines()
    rows = [re.split(r"\s*\|\s*", line)[1:3] for line in lines if line.startswith("| ")][1:]
    terms = [term.lower() for term, _ in rows]
    assert len(terms) > 30
    assert terms == sorted(terms)
    for term, meaning in rows:
        assert 1 <= len(re.findall(r"\.(?=\s|$)", meaning.split("[More]")[0].strip())) <= 2, term


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
