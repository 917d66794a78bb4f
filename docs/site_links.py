"""What mkdocs does besides (`hooks` in mkdocs.yml): pages link to files outside docs/ as they do on a code host.

A file outside docs/ that a page links to becomes a part of the site, under `repository/` and its own path; a page there
brings what it links to itself. A folder has no page to lead to: its link becomes plain text.
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
HOME = "index.md"
OUTSIDE = "repository"
LINK = re.compile(r"^```.*?^```$|`[^`\n]*`|(?P<text>!?\[[^\[\]]*\])\((?P<target>[^)\s]+)\)", re.MULTILINE | re.DOTALL)
"""Code, which is left alone, or a link."""


def on_files(files: Any, config: Any) -> Any:
    """Add the README as the first page, and all that pages outside docs/ and pages link to."""
    from mkdocs.structure.files import File

    waiting = [page_source(file.src_uri) for file in files if file.src_uri.endswith(".md")]
    waiting.append(ROOT / "README.md")
    files.append(File.generated(config, HOME, abs_src_path=str(ROOT / "README.md")))
    seen = {file.src_uri for file in files}
    while waiting:
        page = waiting.pop()
        for path in linked(page):
            uri = place_of(path)
            if uri in seen or not path.is_file():
                continue
            seen.add(uri)
            files.append(File.generated(config, uri, abs_src_path=str(path)))
            if path.suffix == ".md":
                waiting.append(path)
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Point links where the site has their files."""
    return for_site(markdown, page_source(page.file.src_uri))


def page_source(uri: str) -> Path:
    """Return the file of a page of the site."""
    if uri == HOME:
        return ROOT / "README.md"
    head, _, rest = uri.partition("/")
    return ROOT / rest if head == OUTSIDE else ROOT / "docs" / uri


def place_of(path: Path) -> str:
    """Return where the site has a file of the repository."""
    inner = path.relative_to(ROOT).as_posix()
    if inner == "README.md":
        return HOME
    return inner.removeprefix("docs/") if inner.startswith("docs/") else f"{OUTSIDE}/{inner}"


def linked(page: Path) -> Iterator[Path]:
    """Yield the files and folders of the repository that a page links to."""
    for match in LINK.finditer(page.read_text(encoding="utf-8")):
        if match["target"] and not is_elsewhere(match["target"]):
            yield (page.parent / match["target"].partition("#")[0]).resolve()


def is_elsewhere(target: str) -> bool:
    """Whether a link leads to another site, or to a place on its own page."""
    return target.startswith(("#", "http://", "https://", "mailto:"))


def for_site(markdown: str, page: Path) -> str:
    """Return a page's text with its links as the site needs them."""

    def rewritten(match: re.Match[str]) -> str:
        if not match["target"] or is_elsewhere(match["target"]):
            return match[0]
        file, hash_, anchor = match["target"].partition("#")
        path = (page.parent / file).resolve()
        if path.is_dir():
            return match["text"].strip("[]")
        target = posixpath.relpath(place_of(path), posixpath.dirname(place_of(page)) or ".")
        return f"{match['text']}({target}{hash_}{anchor})"

    return LINK.sub(rewritten, markdown)
