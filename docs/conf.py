"""The site, by ``make docs``. Every warning is an error: a dead link, an unknown name."""

import re
import sys
from pathlib import Path

from docutils import nodes
from docutils.statemachine import StringList
from sphinx.util.docutils import SphinxDirective

import hpid_ros

sys.path.insert(0, str(Path(__file__).parent))

import declared

project = "hpid_ros"
author = "The hpid_ros developers"
copyright = author
version = release = hpid_ros.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.mathjax"]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = f"hpid_ros {version}"
html_show_sphinx = False
html_static_path = ["_static"]
html_css_files = ["site.css"]

myst_heading_anchors = 4
suppress_warnings = ["myst.header"]  # pages may begin a part with a smaller heading

autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_default_options = {"members": True, "undoc-members": False}
napoleon_numpy_docstring = False
napoleon_use_ivar = True

LINK = re.compile(r"\[(?P<text>[^]]+)\]\((?P<target>[^)#:]+)(?:#[^)]*)?\)")


def setup(app):
    """Let pages of the site be read in the repository, too."""
    app.add_directive("declared", Declared)
    app.connect("source-read", without_links_outside)


class Declared(SphinxDirective):
    """A table of :mod:`declared`; its content is for who reads the page in the repository."""

    required_arguments = 1
    has_content = True

    def run(self):
        """Return the table."""
        box = nodes.container()
        lines = declared.markdown(self.arguments[0])
        self.state.nested_parse(StringList(lines, self.get_source_info()[0]), 0, box)
        return box.children


def without_links_outside(app, page, source):
    """Leave the text of links to pages and folders that are beside the site, not in it."""
    here = (Path(app.srcdir) / page).parent

    def kept(match):
        target = (here / match["target"]).resolve()
        is_outside = not target.is_relative_to(Path(app.srcdir).resolve())
        return match["text"] if is_outside and target.suffix in ("", ".md") else match[0]

    source[0] = LINK.sub(kept, source[0])
