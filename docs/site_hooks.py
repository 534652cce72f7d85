"""What `mkdocs build` does to the pages: the README becomes the first one, and links out of docs/ lead to the repository."""

import posixpath
import re
from pathlib import Path

from mkdocs.structure.files import File

ROOT = Path(__file__).parents[1]
LINK = re.compile(r"\]\((?!\w+:|#)([^)#\s]+)")  # a relative one, up to its anchor


def on_files(files, config):
    """The README as docs/index.md, so that it need not be written twice; its links are as from within docs/."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    text = LINK.sub(lambda link: "](" + posixpath.relpath(link[1], "docs"), text)
    files.append(File.generated(config, "index.md", content=text))
    return files


def on_page_markdown(markdown, page, config, files):
    """Links from a page to scripts, data and folders, which are no pages, lead to the repository."""
    folder = posixpath.join("docs", posixpath.dirname(page.file.src_uri))

    def repository(link):
        path = posixpath.normpath(posixpath.join(folder, link[1]))
        return link[0] if path.startswith("docs/") else f"]({config['extra']['source']}/{path}"

    return LINK.sub(repository, markdown)
