"""Hook of `mkdocs.yml`: the site has the folders of the repository, with README.md as its front
page.

So a link from one page to another, to a picture or to a source file is the same on the site and in
the repository, and no text has a second copy.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files

ROOT = Path(__file__).resolve().parent.parent
PAGES = "*.md", "benchmarks/README.md", "scenes/README.md", "docs/**/*.md"
ASSETS = "docs/images/**/*.*", "docs/site.css"
LINK = re.compile(r"\]\((?!https?:|#)([^)#\s]+)[^)]*\)")


def linked(page: Path) -> set[Path]:
    """The files of the repository to which a page links."""
    targets = {(page.parent / name).resolve() for name in LINK.findall(page.read_text("utf-8"))}
    return {target for target in targets if target.is_file() and target.is_relative_to(ROOT)}


def site_files() -> list[str]:
    """Paths of all files of the site, relative to the repository."""
    pages = {page for pattern in PAGES for page in ROOT.glob(pattern)}
    files = pages | {asset for pattern in ASSETS for asset in ROOT.glob(pattern)}
    files |= {target for page in pages for target in linked(page)}
    return sorted(file.relative_to(ROOT).as_posix() for file in files)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """The files of the repository in place of those of `docs_dir`; the theme's files stay."""
    from mkdocs.structure.files import File, Files

    directories = config.use_directory_urls
    ours = [File(path, str(ROOT), config.site_dir, directories) for path in site_files()]
    return Files([*(file for file in files if file.src_dir != config.docs_dir), *ours])
