"""Makes pages of the site from the files at the top, and ends links that lead out of it in plain words."""

import posixpath
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

PAGES = {"README.md": "index.md", "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}
# What the theme's offline search would fetch, and what stands in for it.
_FETCHED = "https://unpkg.com/iframe-worker/shim"
_FROM_DISK = "worker_from_disk.js"
_LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s]+)\)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """README and its like are pages too."""
    top = Path(config.config_file_path).parent
    files.append(
        File.generated(config, _FROM_DISK, content=(top / "docs/site" / _FROM_DISK).read_text(encoding="utf-8"))
    )
    for source, page in PAGES.items():
        files.append(File.generated(config, page, content=(top / source).read_text(encoding="utf-8")))
    return files


def on_post_page(output: str, page: Page, config: MkDocsConfig) -> str:
    """The search works from disk without a network."""
    return output.replace(_FETCHED, posixpath.relpath(_FROM_DISK, posixpath.dirname(page.url) or "."))


def on_post_template(output_content: str, template_name: str, config: MkDocsConfig) -> str:
    """The page for what is not found, too."""
    return output_content.replace(_FETCHED, f"/{_FROM_DISK}")


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Links as they are right in the repository become right in the site."""
    is_top = page.file.src_uri in PAGES.values()
    folder = "" if is_top else posixpath.dirname(f"docs/{page.file.src_uri}")
    return _LINK.sub(lambda link: _in_site(link, folder, files), markdown)


def _in_site(link: re.Match[str], folder: str, files: Files) -> str:
    """Return a link of a page as the site has it.

    Args:
        link: in the page.
        folder: of the page in the repository.
        files: of the site.
    """
    mark, text, target = link.groups()
    if re.match(r"[a-z]+:|#", target):
        return link[0]
    path, _, anchor = target.partition("#")
    path = posixpath.normpath(posixpath.join(folder, path))
    path = PAGES.get(path, path.removeprefix("docs/"))
    if files.get_file_from_path(path) is None and not path.endswith(".md"):
        return text  # source code and the like
    path = posixpath.relpath(path, folder.removeprefix("docs").removeprefix("/") or ".")
    return f"{mark}[{text}]({path}{'#' + anchor if anchor else ''})"
