"""What mkdocs calls while it builds the site: it adds the pages that are made from code and data."""

import re

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files

from tests.docs.gallery import gallery
from tests.docs.reference import reference

# What a page fetches when it is opened; links that a reader follows may lead anywhere.
_FETCHED = re.compile(
    r"<(?:script|img|iframe|source)\b[^>]*\bsrc=\"?(\w+:)?//|<link\b[^>]*\bhref=\"?(\w+:)?//"
)
_IMAGE_WITHOUT_WORDS = re.compile(r"<img\b(?![^>]*\balt=\"[^\"]+\")[^>]*>")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the reference and the gallery."""
    for place, text in {**reference(), "gallery.md": gallery()}.items():
        files.append(File.generated(config, place, content=text))
    return files


def on_post_page(output: str, page: object, config: MkDocsConfig) -> str:
    """Refuse a page that fetches something from elsewhere, or has a picture without words."""
    for pattern, what in ((_FETCHED, "is fetched from elsewhere"), (_IMAGE_WITHOUT_WORDS, "has no alt")):
        if found := pattern.search(output):
            raise PluginError(f"{page}: {found[0]} ... {what}")
    return output
