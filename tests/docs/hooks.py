"""What mkdocs calls while it builds the site: it adds the pages that are made from code and data."""

import posixpath
import re

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from tests.docs.gallery import gallery
from tests.docs.reference import reference

# What a page fetches when it is opened; links that a reader follows may lead anywhere.
_FETCHED = re.compile(
    r"<(?:script|img|iframe|source)\b[^>]*\bsrc=\"?(\w+:)?//|<link\b[^>]*\bhref=\"?(\w+:)?//"
)
_TO_SOURCE = re.compile(r'href="(?!\w+:)([^"#]+\.(?:md|ipynb))(#[^"]*|)"')
_IMAGE_WITHOUT_WORDS = re.compile(r"<img\b(?![^>]*\balt=\"[^\"]+\")[^>]*>")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the reference and the gallery."""
    for place, text in {**reference(), "gallery.md": gallery()}.items():
        files.append(File.generated(config, place, content=text))
    return files


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Point the links of a notebook to pages: mkdocs leaves them at sources. Refuse one that is dead."""
    if not page.file.src_uri.endswith(".ipynb"):
        return html

    def to_page(link: re.Match[str]) -> str:
        place = posixpath.join(posixpath.dirname(page.file.src_uri), link[1])
        target = files.get_file_from_path(posixpath.normpath(place))
        if target is None:
            raise PluginError(f"{page.file.src_uri}: links to {link[1]}, which is no page")
        return f'href="{target.url_relative_to(page.file)}{link[2]}"'

    return _TO_SOURCE.sub(to_page, html)


def on_post_page(output: str, page: object, config: MkDocsConfig) -> str:
    """Refuse a page that fetches something from elsewhere, or has a picture without words."""
    for pattern, what in ((_FETCHED, "is fetched from elsewhere"), (_IMAGE_WITHOUT_WORDS, "has no alt")):
        if found := pattern.search(output):
            raise PluginError(f"{page}: {found[0]} ... {what}")
    return output
