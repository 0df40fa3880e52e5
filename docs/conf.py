"""Configuration of the documentation; `make docs` builds it, with warnings as errors."""

import inspect
import os
import re
import shutil
import sys
from importlib.metadata import version as installed
from pathlib import Path
from typing import Any

from sphinxcontrib.programoutput import run_programs

HERE = Path(__file__).parent
# The commands of a page run in one folder, from top to bottom, by the program that builds the pages.
RUN = HERE / "run"
shutil.rmtree(RUN, ignore_errors=True)
RUN.mkdir()
shutil.copy(HERE / "data" / "pendula.csv", RUN)
os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
os.environ["OMP_NUM_THREADS"] = "1"

project = "latticebench"
author = "The latticebench authors"
copyright = author
version = release = installed("latticebench")
extensions = [
    "myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_gallery.gen_gallery",
    "sphinxcontrib.programoutput", "sphinx_copybutton",
]  # fmt: skip
exclude_patterns = ["run", "examples", "data", "gallery/**/*.ipynb", "gallery/*.py"]
myst_enable_extensions = ["deflist"]
myst_heading_anchors = 3
suppress_warnings = ["config.cache"]

html_theme = "pydata_sphinx_theme"
html_title = "latticebench"
html_theme_options = {
    "show_prev_next": True,
    "navbar_end": ["theme-switcher"],
    "navigation_with_keys": False,
    "header_links_before_dropdown": 5,
}
# The pages have no sections of their own.
html_sidebars = {"**": []}
html_show_sourcelink = False
copybutton_prompt_text = r"\$ |>>> |\.\.\. "
copybutton_prompt_is_regexp = True
programoutput_prompt_template = "$ {command}\n{output}"

# Docstrings have the sections of Google's style, which napoleon reads; signs of reStructuredText in formulas are text.
default_role = "literal"
napoleon_numpy_docstring = False
napoleon_use_ivar = True
autodoc_typehints = "none"
autodoc_member_order = "bysource"

sphinx_gallery_conf = {
    "examples_dirs": "examples",
    "gallery_dirs": "gallery",
    "abort_on_example_error": True,
    "show_memory": False,
    # Its tables would be loaded from the network.
    "write_computation_times": False,
    "remove_config_comments": True,
    "download_all_examples": False,
    "image_scrapers": ("matplotlib",),
    "matplotlib_animations": True,
    "plot_gallery": True,
    "capture_repr": (),
}


def literal(_app: Any, _what: str, _name: str, _object: Any, _options: Any, lines: list[str]) -> None:
    """Keep bars, stars and underscores of formulas as they are; an example is literal anyway, up to an empty line."""
    lines[:] = inspect.cleandoc("\n".join(lines)).splitlines()
    example = False
    for number, line in enumerate(lines):
        example = bool(line.strip()) and (example or line.lstrip().startswith(">>>"))
        if example:
            continue
        parts = line.split("`")
        parts[::2] = [re.sub(r"([|*]|_(?=\W|$))", r"\\\1", part) for part in parts[::2]]
        lines[number] = "`".join(parts)


def setup(app: Any) -> None:
    """Read docstrings as text, and run the commands of a page before its pictures are looked for."""
    app.connect("autodoc-process-docstring", literal, priority=100)
    app.connect("doctree-read", run_programs, priority=100)
